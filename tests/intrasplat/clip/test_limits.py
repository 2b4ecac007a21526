"""What a clip may take: the limit counts what is really held, and follows the machine's memory."""

from __future__ import annotations

import numpy as np
import pytest

from contract.runtime.settings import Settings
from intrasplat.clip import ClipLimits, open_clip
from intrasplat.decode import decoding
from intrasplat.errors import LimitError
from intrasplat.intake import limits as limits_module
from intrasplat.intake.limits import CLIP_BYTES_PER_PIXEL, memory_for_clip_bytes
from intrasplat.train.targets import TrainingFrames
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip

GIB = 1024**3


def arrays_bytes(value: object) -> int:
    return sum(array.nbytes for array in vars(value).values() if isinstance(array, np.ndarray))


def test_a_pixel_takes_what_both_eyes_of_the_clip_hold_of_it_and_training_frames_no_more() -> None:
    left, right = plane_clip(12), plane_clip(12)
    held = sum(arrays_bytes(eye) + arrays_bytes(TrainingFrames(eye, range(12), 1.0)) for eye in (left, right))
    pixels = 12 * HEIGHT * WIDTH
    assert CLIP_BYTES_PER_PIXEL - 1 < held / pixels <= CLIP_BYTES_PER_PIXEL + 1  # poses and frame times, too


@pytest.mark.parametrize(
    ("there", "clip", "decoder"),
    [
        (2 * GIB, GIB, 4 / 3 * GIB),
        (8 * GIB, 4 * GIB, 16 / 3 * GIB),
        (64 * GIB, 8 * GIB, 10 * GIB),
        (None, 8 * GIB, 10 * GIB),
    ],
)
def test_a_clip_takes_half_of_the_memory_at_most_and_its_decoder_two_thirds(
    monkeypatch: pytest.MonkeyPatch, there: int | None, clip: int, decoder: float
) -> None:
    for module in (limits_module, decoding):
        monkeypatch.setattr(module, "memory_bytes", lambda: there)
    assert ClipLimits().decoded_bytes == memory_for_clip_bytes() == clip
    assert decoding.allowance_of(ClipLimits()).memory_bytes == pytest.approx(decoder, abs=1)


def test_a_clip_that_does_not_fit_is_told_how_many_of_its_frames_do() -> None:
    limits = ClipLimits(clip_bytes=GIB)
    fitting = GIB // (1280 * 1024 * CLIP_BYTES_PER_PIXEL)
    limits.check_clip("clip", "it", fitting, 1280, 1024, eyes=1)
    with pytest.raises(LimitError, match=r"1280x1024 pixels; .* limit of 1024.0 MiB holds 45") as caught:
        limits.check_clip("clip", "it", fitting + 1, 1280, 1024, eyes=1)
    assert caught.value.remedy == "Cut it to 45 frames, or scale it down."
    limits.check_clip("clip", "it", 2 * fitting, 1280, 1024, eyes=2)
    with pytest.raises(LimitError, match="holds 0") as caught:
        ClipLimits(clip_bytes=1000).check_clip("clip", "it", 1, 1280, 1024)
    assert caught.value.remedy == "Scale it down."


def test_only_a_clip_that_has_its_depth_must_fit_into_memory() -> None:
    limits = ClipLimits(decoded_bytes=2 * GIB)  # a machine of 4 GiB
    limits.check_clip("clip", "it", 1000, 640, 512, eyes=1)
    with pytest.raises(LimitError, match=r"of memory, and the limit of 2048\.0 MiB holds 364"):
        limits.check_clip("clip", "it", 1000, 640, 512, eyes=1, has_depth=True)


def test_the_limits_are_the_deployments() -> None:
    limits = Settings(max_frames=7, max_clip_s=2.5, max_frame_pixels=1000).clip_limits
    with pytest.raises(LimitError, match="the limit is 7"):
        limits.check_clip("clip", "it", 8, 20, 20)
    with pytest.raises(LimitError, match=r"lasts 2\.6 s; the limit is 2\.5 s"):
        limits.check_duration("clip", "it", 2.6)
    limits.check_frame("clip", "it", 80, 25)  # two eyes side by side
    limits.check_clip("clip", "it", 1, 40, 25, eyes=1)
    with pytest.raises(LimitError, match="an eye of it has 80x25 pixels; the limit is 1000"):
        limits.check_clip("clip", "it", 1, 80, 25, eyes=1)


def test_a_video_that_lasts_too_long_is_refused(studio) -> None:
    clip = studio.video("clip.webm", np.concatenate(studio.eyes(6), axis=2), rate_hz=2.0)
    with pytest.raises(LimitError, match="the limit is 2 s"):
        open_clip(clip, limits=ClipLimits(duration_s=2.0))
