"""Views with detail from the recorded training frames: as recorded where that was seen, the model everywhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, FrameSplit
from intrasplat.errors import SceneError
from intrasplat.notices import NoticeCode
from intrasplat.outcome import scene_of
from intrasplat.scene.recorded_video import RecordedEye
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.view.detail import CACHED, _together, detail_bytes
from intrasplat.view.recorded import ClipPictures
from intrasplat.view.render import render_frame
from intrasplat.view.transfer import ONE, carry
from lab.phantom import orbit_pose
from tests.intrasplat.phantoms import FRAMES, phantom_clip, prepared, trained


@dataclasses.dataclass(frozen=True, eq=False)
class Pictures:
    """ClipPictures whose pictures a test may change; it notes those that are read."""

    clip: ClipPictures
    frames: Sequence[int]
    gains: Sequence[float] = (1.0,) * FRAMES
    is_tissue: bool = True
    is_readable: bool = True
    read: list[int] = dataclasses.field(default_factory=list)

    @property
    def eyes(self) -> Sequence[RecordedEye]:
        return self.clip.eyes

    def picture(self, eye: int, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        if not self.is_readable:
            raise SceneError("The recorded frames are damaged.")
        self.read.append(frame)
        rgb, tissue = self.clip.picture(eye, frame)
        return np.clip(rgb * self.gains[frame] + 0.5, 0, 255).astype(np.uint8), tissue & self.is_tissue


@pytest.fixture(scope="module")
def made() -> tuple[TrainedScene, DepthClip, FrameSplit]:
    clip = phantom_clip()
    run, split = prepared(clip, "fast", iterations=40)
    run.motion_error = None  # the motion counts as followed, though the clip is short and breathes fast
    return scene_of(trained(run)), clip, split


Made = tuple[TrainedScene, DepthClip, FrameSplit]


def with_pictures(made: Made, frames: Sequence[int] | None = None, **changes: object) -> tuple[TrainedScene, Pictures]:
    scene, clip, split = made
    shown = split.train if frames is None else frames
    pictures = dataclasses.replace(Pictures(ClipPictures(clip, 1, shown), shown), **changes)  # type: ignore[arg-type]
    return dataclasses.replace(scene, pictures=pictures), pictures


def mean_db(scene: TrainedScene, clip: DepthClip, frames: Sequence[int]) -> float:
    shown = ((render_frame(scene, frame / FRAMES).rgb, frame) for frame in frames)
    return float(np.mean([psnr_tissue(rgb, clip.rgb[frame], clip.tissue[frame]) for rgb, frame in shown]))


def test_at_a_recorded_moment_the_recorded_tissue_comes_back(made: Made) -> None:
    scene, clip, split = made
    frames = split.train[2:6]
    assert mean_db(with_pictures(made)[0], clip, frames) > max(38, mean_db(scene, clip, frames) + 6)


def test_held_out_moments_gain_without_their_own_frames(made: Made) -> None:
    scene, clip, split = made
    everything = range(FRAMES)
    detailed, pictures = with_pictures(made, everything)
    assert mean_db(detailed, clip, split.held_out) > mean_db(scene, clip, split.held_out) + 0.5
    assert pictures.read
    assert not set(pictures.read) & set(split.held_out)


def test_nothing_is_added_where_no_tissue_was_seen(made: Made) -> None:
    shown = render_frame(with_pictures(made, is_tissue=False)[0], 0.4)
    np.testing.assert_allclose(shown.rgb, render_frame(made[0], 0.4).rgb, atol=1)
    assert shown.detail_share == 0


def test_off_shows_the_model_alone_and_on_says_how_much_is_recorded(made: Made) -> None:
    detailed, _ = with_pictures(made)
    off, on = (render_frame(detailed, 0.4, detail=detail) for detail in ("off", "on"))
    np.testing.assert_array_equal(off.rgb, render_frame(made[0], 0.4).rgb)
    assert off.detail_share == 0
    assert 0.5 < on.detail_share <= 1
    np.testing.assert_array_equal(on.depth_mm, off.depth_mm)
    np.testing.assert_array_equal(on.confidence, off.confidence)  # one eye alone bears nothing out


def test_confidence_grows_where_frames_of_two_eyes_reach_and_nowhere_else(made: Made) -> None:
    detailed = dataclasses.replace(with_pictures(made)[0], right_eye_mm=(4.0, 0.0, 0.0))
    for angle, (low, high) in ((0, (0.02, 0.2)), (60, (-0.2, 0.0))):
        off, on = (render_frame(detailed, 0.4, orbit_pose(angle, 0), detail=detail) for detail in ("off", "on"))
        assert low < on.confidence.mean() - off.confidence.mean() < high


def test_it_fades_with_the_angle(made: Made) -> None:
    detailed, _ = with_pictures(made)
    views = [orbit_pose(angle, 0) for angle in (0, 5, 10, 60)]
    near, beside, farther, far = (render_frame(detailed, 0.4, pose).detail_share for pose in views)
    assert near > beside > farther > far == 0
    np.testing.assert_allclose(
        render_frame(detailed, 0.4, views[-1]).rgb, render_frame(made[0], 0.4, views[-1]).rgb, atol=1
    )


def test_nothing_pops_where_the_nearest_frames_change(made: Made) -> None:
    detailed, _ = with_pictures(made)
    for frame in made[2].train[2:5]:
        before, at, after = (render_frame(detailed, (frame + share) / FRAMES).rgb for share in (-1e-3, 0.0, 1e-3))
        assert np.abs(before.astype(int) - at).max() <= 3
        assert np.abs(after.astype(int) - at).max() <= 3


def test_unreadable_frames_leave_the_model_and_a_warning(made: Made) -> None:
    shown = render_frame(with_pictures(made, is_readable=False)[0], 0.4)
    np.testing.assert_array_equal(shown.rgb, render_frame(made[0], 0.4).rgb)
    assert [each.code for each in shown.warnings] == [NoticeCode.DETAIL_MISSING]


def test_detail_has_the_light_of_the_view(made: Made) -> None:
    scene, clip, split = made
    gains = [0.6 + 0.03 * frame for frame in range(FRAMES)]
    changes = {"log_gains": np.log(np.repeat(gains, 3).reshape(-1, 3)).tolist()}
    spoilt, _ = with_pictures(made, gains=gains)
    spoilt = dataclasses.replace(spoilt, settings=scene.settings | changes)
    frame = split.train[3]
    assert mean_db(spoilt, clip, [frame]) > 36  # as if nothing had been spoilt
    recorded = render_frame(spoilt, frame / FRAMES, light="recorded").rgb
    dark = np.clip(clip.rgb[frame] * gains[frame], 0, 255).astype(np.uint8)
    assert psnr_tissue(recorded, dark, clip.tissue[frame]) > 36


def test_few_residuals_stay_in_memory(made: Made) -> None:
    detailed, pictures = with_pictures(made)
    frames = made[2].train
    assert len(frames) > CACHED
    for frame in (*frames, *frames[-CACHED:], frames[0]):
        render_frame(detailed, frame / FRAMES)
    assert pictures.read == [*frames, frames[0]]
    pixels, k = 12 * made[1].tissue[0].size, len(detailed.gaussians)
    assert CACHED * pixels < detail_bytes(detailed) < CACHED * (1.2 * pixels + 12 * k)
    assert detail_bytes(made[0]) == 0


def test_what_one_eye_misses_alone_stays_near_that_eye() -> None:
    rng, ones = np.random.default_rng(0), np.ones((40, 50), np.float32)
    alike, glare = (rng.normal(0, 0.1, (40, 50, 3)).astype(np.float32) for _ in range(2))
    seen = {0: (alike + glare, ones), 1: (alike, ones)}
    at_left, _ = _together(seen, [ones, 0 * ones], ones)
    np.testing.assert_allclose(at_left, alike + glare, atol=1e-6)
    at_right, _ = _together(seen, [0 * ones, ones], ones)
    np.testing.assert_allclose(at_right, alike, atol=1e-6)
    beside, _ = _together(seen, [0 * ones, 0 * ones], ones)
    assert np.corrcoef(beside.ravel(), alike.ravel())[0, 1] > 0.85
    only, _ = _together({0: (glare, ones), 1: (0 * glare, ones)}, [0 * ones, 0 * ones], ones)
    assert np.abs(only).max() < 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class TwoEyed:
    """A left eye that sees a highlight at SPOT in every frame, and a right one that sees what the model shows."""

    clip: ClipPictures
    frames: Sequence[int]
    scene: TrainedScene

    @property
    def eyes(self) -> Sequence[RecordedEye]:
        (left,) = self.clip.eyes
        beside = np.eye(4)
        beside[0, 3] = 4.0
        return left, RecordedEye(left.lens, beside)

    def picture(self, eye: int, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        rgb, tissue = self.clip.picture(0, frame)
        if eye == 0:
            rgb = rgb.copy()
            rgb[SPOT] = 255
            return rgb, tissue
        pose = self.scene.world_from_camera[0] @ self.eyes[1].left_from_eye
        return render_frame(self.scene, frame / FRAMES, pose).rgb, tissue


SPOT = (slice(36, 44), slice(60, 68))


def test_without_highlights_nothing_is_added_that_one_of_two_eyes_saw_alone(made: Made) -> None:
    scene, clip, split = made
    pictures = TwoEyed(ClipPictures(clip, 1, split.train), split.train, scene)
    seen = dataclasses.replace(scene, pictures=pictures)
    t = split.train[3] / FRAMES
    alone, bright, dull = (
        render_frame(each, t, highlights=highlights).rgb[SPOT].mean()
        for each, highlights in ((scene, False), (seen, True), (seen, False))
    )
    assert bright > 240
    assert abs(dull - alone) < 0.2 * (bright - alone)


def test_a_residual_is_carried_along_the_motion_unless_something_hides_the_point() -> None:
    height, width, shift_px, depth_mm = 20, 30, 4, 50.0
    lens = np.array([100, 100, width / 2, height / 2], np.float32)
    planes = np.zeros((height + 2, width + 2, 4), np.int16)
    planes[1:-1, 1:-1, :3] = np.arange(width)[None, :, None] * 100
    planes[1:-1, 1:-1, 3] = ONE
    there_mm = np.full(planes.shape[:2], depth_mm, np.float32)
    there_mm[:5] = depth_mm / 2
    moved_mm = np.zeros((3, 4, 3), np.float32)
    moved_mm[..., 0] = shift_px * depth_mm / lens[0]
    total, shown_mm = np.zeros((height, width, 4), np.float32), np.full((height, width), depth_mm, np.float32)
    carry(
        0, 1, shown_mm, lens, np.eye(4, dtype=np.float32)[:3], moved_mm, planes, there_mm, lens, np.float32(0.06),
        np.float32(0.5), total,
    )  # fmt: skip
    inside = np.s_[6:, : width - shift_px - 1]
    wanted = 0.5 * 100 / ONE * (np.arange(width)[None, : width - shift_px - 1, None] + shift_px)
    np.testing.assert_allclose(total[inside][..., :3], np.broadcast_to(wanted, total[inside][..., :3].shape), rtol=1e-4)
    np.testing.assert_allclose(total[inside][..., 3], 0.5, rtol=1e-5)
    assert not total[:3].any()  # hidden by what is nearer
    assert not total[:, width - shift_px + 1 :].any()  # outside the eye's picture
