"""A clip whose decoding process is killed is decoded again, not without end; frames that show nothing new stay out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import held_out_frames
from intrasplat.clip.types import PIXELS
from intrasplat.decode import DecoderKilledError, decode_clip
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.stereo import ClipPaths, open_with_depth, opening
from intrasplat.stereo.opening import match_eyes
from lab.phantom import PhantomSettings, make_phantom, write_endonerf


@pytest.mark.parametrize("deaths", [0, opening.TRIES - 1, opening.TRIES])
def test_a_killed_decoder_is_tried_again(deaths: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=3)), tmp_path)
    left = deaths

    def decode(*arguments: object, **named: object) -> object:
        nonlocal left
        if left:
            left -= 1
            raise DecoderKilledError
        return decode_clip(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(opening, "decode_clip", decode)
    options = ReconstructionOptions(holdout="none")
    if deaths == opening.TRIES:
        with pytest.raises(DecoderKilledError):
            open_with_depth(ClipPaths(tmp_path), options, Hooks(), Timings())
    else:
        assert open_with_depth(ClipPaths(tmp_path), options, Hooks(), Timings()).frame_count == 3


def test_frames_that_show_nothing_new_get_no_depth_and_change_no_bit_of_the_others() -> None:
    drawn = make_phantom(PhantomSettings(width=160, height=128, frames=24, tools=())).stereo_recording()
    pairs = list(drawn.clip.pairs())
    shown = [*range(12), *[11] * 106, *range(12, 24)]
    paused = dataclasses.replace(
        drawn.clip,
        frame_count=len(shown),
        pairs=lambda: (pairs[moment] for moment in shown),
        tissue=None,
        frame_times_s=np.arange(len(shown)) / 25,
    )
    whole, sampled = (
        match_eyes(paused, drawn.calibration, "every8", Hooks(), Timings(), skip_redundant=each)
        for each in (False, True)
    )
    assert whole.skipped == ()
    assert len(sampled.skipped) > 30
    assert set(sampled.skipped) <= set(range(12, 118)) - set(held_out_frames(len(shown), "every8"))
    used = np.setdiff1d(range(len(shown)), sampled.skipped)
    for eye, sampled_eye in zip(whole.eyes, sampled.eyes, strict=True):
        for name in PIXELS:
            assert np.array_equal(getattr(eye, name)[used], getattr(sampled_eye, name)[used])
        assert not sampled_eye.depth_mm[list(sampled.skipped)].any()
    assert np.array_equal(sampled.frame_times_s, whole.frame_times_s)
    told = [each.text for each in sampled.assumptions if each.code is NoticeCode.NOTHING_NEW]
    assert [text.split(" show")[0] for text in told] == [f"frames: {len(sampled.skipped)} of 130"]


@pytest.mark.parametrize("use_frames", ["new", "all"])
def test_of_a_long_clip_with_depth_frames_are_left_out_unless_all_are_asked_for(
    use_frames: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("intrasplat.clip.sampling.MIN_USED_FRAMES", 4)
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=12, motion="still", tools=())), tmp_path)
    options = ReconstructionOptions.model_validate({"use_frames": use_frames, "mask_polarity": "tool"})
    clip = open_with_depth(ClipPaths(tmp_path), options, Hooks(), Timings())
    assert clip.skipped == {"new": (2, 4, 5, 7, 8, 11), "all": ()}[use_frames]
