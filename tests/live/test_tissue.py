"""What shows no tissue is recognised, and nothing of it is learnt, shown or kept."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import skimage.data
from numpy.typing import NDArray

from intrasplat.clip.types import RgbFrame
from intrasplat.live.spec import RecordingSpec
from intrasplat.live.state import FeedState
from intrasplat.live.times import FeedTime
from intrasplat.live.tissue import NEAR_S, OUT_S, TissueWatch, has_colours_of_tissue
from lab.phantom import PhantomSettings, make_phantom
from tests.live.conftest import FEED, Follow, phantom, until, until_known
from tests.live.senders import PhantomSender

DATA = Path(os.environ.get("INTRASPLAT_DATA", Path(__file__).parents[2].parent / "shared/data"))
FACE = (slice(0, 220), slice(120, 330))
OUTSIDE: dict[str, RgbFrame] = {
    "a person": skimage.data.astronaut(),
    "a face": skimage.data.astronaut()[FACE],
    "a brown cat": skimage.data.chelsea(),
    "a cup on wood": skimage.data.coffee(),
    "the sky": skimage.data.rocket(),
    "grey": np.repeat(skimage.data.camera()[..., None], 3, axis=2),
    "black": np.zeros((96, 128, 3), np.uint8),
    "noise in the dark": np.random.default_rng(0).integers(0, 12, (96, 128, 3)).astype(np.uint8),
    "white": np.full((96, 128, 3), 250, np.uint8),
    "green cloth": np.full((96, 128, 3), (40, 110, 90), np.uint8),
    "light skin": np.full((96, 128, 3), (205, 160, 130), np.uint8),
    "dark skin": np.full((96, 128, 3), (120, 80, 60), np.uint8),
}


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("blur_px", [0, 15])
def test_what_is_outside_has_no_colours_of_tissue(name: str, blur_px: int) -> None:
    shown = OUTSIDE[name]
    assert not has_colours_of_tissue(cv2.blur(shown, (blur_px, blur_px)) if blur_px else shown)


@pytest.mark.parametrize("seed", range(4))
def test_a_phantom_has_the_colours_of_tissue_also_blurred_and_dim(seed: int) -> None:
    frame = make_phantom(PhantomSettings(128, 96, 2, "still", seed)).frame(0).left
    for shown in (frame, cv2.blur(frame, (15, 15)), (frame * 0.4).astype(np.uint8)):
        assert has_colours_of_tissue(shown)


@pytest.mark.parametrize("name", ["d4d_stereo/stereo_sbs.mp4", "surgt_raw/video.mp4"])
def test_recordings_have_the_colours_of_tissue(name: str) -> None:
    if not (DATA / name).is_file():
        pytest.skip("needs the recorded clips: set INTRASPLAT_DATA")
    with av.open(str(DATA / name)) as container:
        for frame in container.decode(video=0):
            assert has_colours_of_tissue(frame.to_ndarray(format="rgb24"))


def test_recorded_ranges_are_judged_by_the_pairs_around_them() -> None:
    watch = TissueWatch()
    assert watch.keeps(0.0, 1.0) is None
    for tenth in range(10):
        watch.see(tenth / 10, is_tissue=True)
    assert watch.keeps(0.0, 0.9) is True
    assert watch.keeps(0.5, 0.9 + NEAR_S) is True
    assert watch.keeps(0.5, 1.0 + NEAR_S) is None
    assert not watch.see(1.0, is_tissue=False)
    assert watch.keeps(0.5, 1.0) is None  # doubtful
    assert watch.see(0.9 + OUT_S, is_tissue=False)
    assert watch.is_out
    assert watch.keeps(0.5, 1.0) is False
    assert watch.keeps(5.0, 6.0) is False
    assert not watch.may_be_back()
    assert watch.may_be_back()
    watch.see(4.0, is_tissue=True)
    assert not watch.is_out
    assert watch.keeps(3.0, 3.9) is False
    assert watch.keeps(0.0, 0.9) is True
    watch.see(4.1, is_tissue=True)
    watch.end()
    assert watch.keeps(4.05, 9.0) is True


def test_a_lens_that_is_wiped_ends_nothing() -> None:
    watch = TissueWatch()
    watch.see(0.0, is_tissue=True)
    watch.see(OUT_S - 0.1, is_tissue=False)
    watch.see(OUT_S, is_tissue=True)
    assert watch.keeps(0.5, OUT_S) is True


def test_nothing_is_kept_of_what_the_endoscope_sees_outside(
    followed: Follow, sender: PhantomSender, recording: RecordingSpec, tmp_path: Path
) -> None:
    feed = followed(replace(FEED, segments=tmp_path / "segments"), replace(recording, keep_s=60.0))
    until_known(feed, 1.0)
    until(lambda: feed._source.index(), feed.report)
    sender.cover = _both(OUTSIDE["a person"])
    until(lambda: feed.report().state is FeedState.NO_TISSUE, feed.report)
    view, range_before = feed.moment(), feed.report().past
    assert view is not None
    assert range_before is not None
    tissue_until_s = view.source_s
    assert feed._source.index()[-1].to_s <= tissue_until_s + 0.1
    until(lambda: (now := feed.report().numbers.model_age_s) and now > 3.5, feed.report)
    assert feed.report().past == range_before
    sender.cover = None
    newer_s = feed.wait_for_newer(tissue_until_s, 15.0)
    assert newer_s is not None
    until(lambda: feed.report().state in (FeedState.LIVE, FeedState.BEHIND), feed.report)
    until(lambda: feed._source.index()[-1].to_s > newer_s, feed.report)
    outside = [
        each for each in feed._source.index() if each.from_s < newer_s - 0.2 and each.to_s > tissue_until_s + 0.2
    ]
    assert outside == []
    between = feed.moment(FeedTime.of_source((tissue_until_s + newer_s) / 2))
    assert between is not None
    assert [each.code for each in between.notices] == ["time_in_gap"]
    assert not any(tissue_until_s + 0.01 < time_s < newer_s - 0.3 for time_s in _times(feed.segments()))
    with av.open(str(feed.cut(0.0, newer_s + 1.0, tmp_path / "cut.mp4").path)) as container:
        for frame in container.decode(video=0):
            assert has_colours_of_tissue(frame.to_ndarray(format="rgb24"))


def _times(segments: object) -> list[float]:
    return [time_s for each in segments for time_s in each.source_s]  # type: ignore[attr-defined]


def _both(rgb: RgbFrame) -> NDArray[np.uint8]:
    """A picture as both eyes see it, side by side, in the phantom's size."""
    settings = phantom().settings
    eye = np.asarray(cv2.resize(rgb, (settings.width, settings.height), interpolation=cv2.INTER_AREA), np.uint8)
    return np.concatenate([eye, eye], axis=1)
