"""Videos, read by PyAV: as many pictures as the clip, at its rate, that show what renders show."""

from __future__ import annotations

import dataclasses
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError
from intrasplat.export import export_parts, video
from intrasplat.export.video import CIRCLE_S, ROCK_DEG, ROCK_S, STILL_RATE_HZ
from intrasplat.formats import check_export
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.recorded_video import has_encoder
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched
from tests.intrasplat.export.sheet import tissue
from tests.intrasplat.scenes import FRAMES

CLIP_RATE_HZ = 29.97
WIDTH, HEIGHT = 65, 48
BASELINE_MM = (4.3, 0.0, 0.0)


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    """Of both eyes, and of an odd width."""
    camera = Intrinsics(width=WIDTH, height=HEIGHT, fx=80.0, fy=81.0, cx=31.5, cy=24.25)
    return dataclasses.replace(tissue(), intrinsics=camera, right_eye_mm=BASELINE_MM)


def exported(scene: TrainedScene, name: str, **options: object) -> bytes:
    return b"".join(export_parts(scene, name, check_export(name, options)))


CODECS = {"matroska,webm": ("vp8", "libvpx"), "mov,mp4,m4a,3gp,3g2,mj2": ("h264",)}


def read(data: bytes) -> tuple[list[NDArray[np.uint8]], float]:
    """The pictures, RGB, and their rate."""
    with av.open(io.BytesIO(data)) as video:
        (stream,) = video.streams.video
        assert stream.codec_context.name in CODECS[video.format.name]
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)], float(stream.average_rate)


def psnr_db(shown: NDArray[np.uint8], expected: NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(np.mean((shown.astype(float) - expected) ** 2) / 255**2))


def rendered(scene: TrainedScene, t: float, pose: NDArray[np.float64] | None = None) -> NDArray[np.uint8]:
    frame = render_frame(scene, t, pose)
    return hatched(frame.rgb, frame.unseen)[:, : WIDTH - 1]


@pytest.mark.parametrize("name", ["webm", "mp4"])
def test_the_clip_is_shown_at_its_rate(scene: TrainedScene, name: str) -> None:
    pictures, rate_hz = read(exported(scene, name))
    assert rate_hz == pytest.approx(CLIP_RATE_HZ, rel=1e-2)
    assert [each.shape for each in pictures] == [(HEIGHT, WIDTH - 1, 3)] * FRAMES
    for frame, picture in enumerate(pictures):
        assert psnr_db(picture, rendered(scene, frame / FRAMES)) > 30


def test_one_of_so_many_frames_plays_as_long(scene: TrainedScene) -> None:
    pictures, rate_hz = read(exported(scene, "webm", every=2))
    assert (len(pictures), rate_hz) == (3, pytest.approx(CLIP_RATE_HZ / 2, rel=1e-2))
    assert psnr_db(pictures[2], rendered(scene, 4 / FRAMES)) > 30


def test_a_circle_about_one_moment_ends_where_it_began(scene: TrainedScene) -> None:
    pictures, rate_hz = read(exported(scene, "webm", view="orbit", t=0.4))
    assert rate_hz == pytest.approx(STILL_RATE_HZ)
    assert len(pictures) == CIRCLE_S * STILL_RATE_HZ
    assert psnr_db(pictures[0], pictures[-1]) > psnr_db(pictures[0], pictures[len(pictures) // 4]) + 6


def test_rocking_goes_to_both_sides_and_comes_back(scene: TrainedScene) -> None:
    pictures, rate_hz = read(exported(scene, "mp4", view="rock", t=0.4))
    quarter = round(ROCK_S * rate_hz / 4)
    assert len(pictures) == 4 * quarter
    own, pivot_mm = endoscope_pose(scene, 0.4), MEDIAN_DEPTH_UNITS / scene.units_per_mm
    for picture, yaw_deg in ((0, 0.0), (quarter, ROCK_DEG), (2 * quarter, 0.0), (3 * quarter, -ROCK_DEG)):
        turned = np.array(world_from_camera(OrbitPose(yaw_deg=yaw_deg, pitch_deg=0, zoom=1), pivot_mm))
        assert psnr_db(pictures[picture], rendered(scene, 0.4, own @ turned)) > 30


def test_without_an_encoder_of_h264_an_mp4_holds_vp9(scene: TrainedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "has_encoder", lambda name: "264" not in name and has_encoder(name))
    with av.open(io.BytesIO(exported(scene, "mp4"))) as opened:
        assert opened.streams.video[0].codec_context.name in ("vp9", "libvpx-vp9")


def test_a_circle_goes_on_with_the_clip(scene: TrainedScene) -> None:
    circled, _ = read(exported(scene, "webm", view="orbit"))
    assert len(circled) == FRAMES
    assert all(psnr_db(picture, rendered(scene, frame / FRAMES)) < 35 for frame, picture in enumerate(circled))


def test_both_eyes_stand_side_by_side_with_the_middle_in_the_screen(scene: TrainedScene) -> None:
    pictures, _ = read(exported(scene, "mp4", view="stereo"))
    assert [each.shape for each in pictures] == [(HEIGHT, 2 * WIDTH, 3)] * FRAMES
    left, right = pictures[3][:, :WIDTH], pictures[3][:, WIDTH:]
    assert psnr_db(left[:, : WIDTH - 1], rendered(scene, 3 / FRAMES)) > 27
    pose = endoscope_pose(scene, 3 / FRAMES)
    pose[:3, 3] += BASELINE_MM
    unmoved = rendered(scene, 3 / FRAMES, pose)
    shift_px = round(80.0 * BASELINE_MM[0] * scene.units_per_mm / 60)
    assert shift_px == 4
    moved = psnr_db(right[:, 10:50], np.roll(unmoved, shift_px, axis=1)[:, 10:50])
    assert moved > psnr_db(right[:, 10:50], unmoved[:, 10:50]) + 3


def test_a_scene_of_one_eye_asks_for_the_distance_of_the_eyes(scene: TrainedScene) -> None:
    one_eyed = dataclasses.replace(scene, right_eye_mm=None)
    with pytest.raises(InputError, match=r"baseline_mm=4\.3") as refused:
        exported(one_eyed, "webm", view="stereo")
    assert refused.value.field == "baseline_mm"
    assert len(read(exported(one_eyed, "webm", view="stereo", baseline_mm=4.3))[0]) == FRAMES


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"t": 0.5}, "t"),
        ({"t": 0.5, "view": "stereo"}, "t"),
        ({"t": 0.5, "view": "orbit", "every": 2}, "every"),
        ({"t": 0.5, "view": "rock", "every": 2}, "every"),
        ({"baseline_mm": 4.0}, "baseline_mm"),
        ({"baseline_mm": -4.0, "view": "stereo"}, "baseline_mm"),
        ({"view": "above"}, "view"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as refused:
        check_export("webm", options)
    assert refused.value.field == field


def test_nothing_is_left_on_the_disk(scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    parts: Iterator[bytes] = export_parts(scene, "webm", check_export("webm", {}))
    assert next(parts) == b""
    assert list(tmp_path.iterdir())
    parts.close()  # type: ignore[attr-defined]
    assert not list(tmp_path.iterdir())
    exported(scene, "webm")
    assert not list(tmp_path.iterdir())
