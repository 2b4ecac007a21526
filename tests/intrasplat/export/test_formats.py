"""Every format is read back by a program that knows only the format, and holds what the scene does."""

from __future__ import annotations

import dataclasses
import io
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from intrasplat.errors import InputError, LimitError
from intrasplat.export import EXPORTS, PART_BYTES, export_parts, target
from intrasplat.formats import EXPORT_FORMATS, ExportOptions, check_export
from intrasplat.poses.pose_file import read_tum
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.constants import SH_C0
from intrasplat.view.render import render_frame
from tests.intrasplat.scenes import FRAMES, KINDS, random_scene


def exported(scene: TrainedScene, name: str, **options: object) -> bytes:
    parts = list(export_parts(scene, name, check_export(name, options)))
    assert max(len(part) for part in parts) <= PART_BYTES
    return b"".join(parts)


def read_ply(data: bytes) -> np.ndarray:
    ply = PlyData.read(io.BytesIO(data))
    assert (ply.text, ply.byte_order) == (False, "<")
    return ply["vertex"].data


def mean_mm(scene: TrainedScene, t: float) -> np.ndarray:
    return (scene.deformation.deform(scene.gaussians, t).mean / scene.units_per_mm).numpy()


def xyz(rows: np.ndarray) -> np.ndarray:
    return np.stack([rows[axis] for axis in "xyz"], axis=1)


def test_the_service_offers_the_formats_that_have_writers() -> None:
    assert [name for name, each in EXPORT_FORMATS.items() if not each.is_stored] == [*EXPORTS]
    options = {option for each in EXPORT_FORMATS.values() for option in each.options}
    assert options == ExportOptions.model_fields.keys()
    assert len({each.suffix for each in EXPORT_FORMATS.values()}) == len(EXPORT_FORMATS)


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_properties_stand_in_the_order_viewers_expect(sh_degree: int) -> None:
    rows = read_ply(exported(random_scene(sh_degree=sh_degree), "ply"))
    rest = [f"f_rest_{index}" for index in range(3 * ((sh_degree + 1) ** 2 - 1))]
    before = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    after = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert rows.dtype.names == (*before, *rest, *after)
    assert len(rows) == 11


@pytest.mark.parametrize("kind", KINDS)
def test_the_state_at_t_is_written_in_millimetres(kind: str) -> None:
    scene = random_scene(kind, sh_degree=1)
    rows = read_ply(exported(scene, "ply", t=0.4))
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    np.testing.assert_allclose(xyz(rows), mean_mm(scene, 0.4), rtol=1e-6)
    scale_mm = (moved.scale / scene.units_per_mm).numpy()
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(np.exp(rows[f"scale_{axis}"]), scale_mm[:, axis], rtol=1e-5)
        assert not rows[f"n{name}"].any()
    rotation = np.stack([rows[f"rot_{part}"] for part in range(4)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-6)
    expected = torch.nn.functional.normalize(moved.quaternion, dim=-1).numpy()
    np.testing.assert_allclose(rotation, expected, atol=1e-6)
    np.testing.assert_array_equal(rows["opacity"], moved.opacity_logit.numpy())
    for channel in range(3):
        np.testing.assert_array_equal(rows[f"f_dc_{channel}"], moved.sh[:, 0, channel].numpy())
        for index in range(3):  # all of red, then green, then blue
            np.testing.assert_array_equal(
                rows[f"f_rest_{3 * channel + index}"], moved.sh[:, 1 + index, channel].numpy()
            )


def test_a_zip_has_a_ply_for_each_frame_and_their_times() -> None:
    scene = random_scene()
    with zipfile.ZipFile(io.BytesIO(exported(scene, "ply-zip", every=4))) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["times.csv", "000000.ply", "000004.ply"]
        assert archive.read("000004.ply") == exported(scene, "ply", t=4 / FRAMES)
        times = np.loadtxt(io.BytesIO(archive.read("times.csv")), delimiter=",", skiprows=1)
    assert times == pytest.approx(np.array([[0, 0, 0], [4, 4 / FRAMES, scene.frame_times_s[4]]]), abs=1e-6)


def test_a_splat_has_32_bytes_for_each_gaussian_the_most_visible_first() -> None:
    scene = random_scene(count=200)
    data = exported(scene, "splat", t=0.4)
    assert len(data) == 32 * 200
    numbers, whole = np.frombuffer(data, "<f4").reshape(-1, 8), np.frombuffer(data, "u1").reshape(-1, 32)
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    expected_mm = mean_mm(scene, 0.4)
    order = [int(np.abs(expected_mm - row[:3]).sum(axis=1).argmin()) for row in numbers]
    assert sorted(order) == list(range(200))
    np.testing.assert_allclose(numbers[:, :3], expected_mm[order], rtol=1e-6)
    np.testing.assert_allclose(numbers[:, 3:6], (moved.scale / scene.units_per_mm).numpy()[order], rtol=1e-5)
    colour = np.clip(0.5 + SH_C0 * moved.sh[:, 0].numpy()[order], 0, 1)
    assert np.abs(whole[:, 24:27] / 255 - colour).max() <= 0.51 / 255
    assert np.abs(whole[:, 27] / 255 - moved.opacity.numpy()[order]).max() <= 0.51 / 255
    rotation = torch.nn.functional.normalize(moved.quaternion, dim=-1).numpy()[order]
    assert np.abs((whole[:, 28:32].astype(float) - 128) / 128 - rotation).max() <= 1.01 / 128
    shown = whole[:, 27] * numbers[:, 3:6].prod(axis=1)
    assert shown[0] > np.median(shown) > shown[-1]


def test_points_are_the_gaussians_centres_with_their_colours_and_trust() -> None:
    scene = random_scene(count=200)
    rows = read_ply(exported(scene, "points", t=0.4))
    assert rows.dtype.names == ("x", "y", "z", "red", "green", "blue", "alpha", "trust")
    np.testing.assert_allclose(xyz(rows), mean_mm(scene, 0.4), rtol=1e-6)
    np.testing.assert_array_equal(rows["trust"], scene.seen.numpy())
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    colour = np.clip(0.5 + SH_C0 * moved.sh[:, 0].numpy(), 0, 1)
    found = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1) / 255
    assert np.abs(found - colour).max() <= 0.51 / 255


def test_depth_is_what_renders_show_in_millimetres() -> None:
    scene = random_scene(count=300)
    depth_mm = np.load(io.BytesIO(exported(scene, "depth", every=2)), allow_pickle=False)
    assert (depth_mm.shape, depth_mm.dtype) == ((3, 48, 64), np.float32)
    for index, frame in enumerate((0, 2, 4)):
        shown = render_frame(scene, frame / FRAMES)
        np.testing.assert_array_equal(depth_mm[index], np.where(shown.unseen, 0, shown.depth_mm))
    assert (depth_mm > 0).any()


def test_tracks_follow_every_gaussian_through_every_frame() -> None:
    scene = random_scene(count=20)
    with np.load(io.BytesIO(exported(scene, "tracks")), allow_pickle=False) as tracks:
        assert tracks["positions_mm"].shape == (FRAMES, 20, 3)
        for frame in range(FRAMES):
            np.testing.assert_allclose(tracks["positions_mm"][frame], mean_mm(scene, frame / FRAMES), rtol=1e-6)
        np.testing.assert_array_equal(tracks["time_s"], scene.frame_times_s)
        np.testing.assert_array_equal(tracks["t"], np.arange(FRAMES) / FRAMES)
        np.testing.assert_array_equal(tracks["frame"], np.arange(FRAMES))
        np.testing.assert_array_equal(tracks["world_from_camera"], scene.world_from_camera)
        np.testing.assert_array_equal(tracks["trust"], scene.seen.numpy())
        assert (tracks["colour"].shape, tracks["opacity"].shape) == ((20, 3), (20,))
        assert set(tracks.files) == {
            *("positions_mm", "time_s", "t", "frame", "world_from_camera", "trust", "colour", "opacity")
        }


def test_a_tum_file_has_every_frames_pose_in_metres(tmp_path: Path) -> None:
    scene = random_scene()
    turned = scene.world_from_camera.copy()
    turned[:, :3, :3] = Rotation.from_euler(
        "xyz", [[5 * each, -3, 2 * each] for each in range(FRAMES)], True
    ).as_matrix()
    scene = dataclasses.replace(scene, world_from_camera=turned)
    content = exported(scene, "tum")
    rows = np.loadtxt(io.BytesIO(content))  # timestamp tx ty tz qx qy qz qw
    assert rows.shape == (FRAMES, 8)
    assert rows[:, 0] == pytest.approx(scene.frame_times_s, abs=1e-6)
    assert rows[:, 1:4] == pytest.approx(turned[:, :3, 3] / 1000, abs=1e-7)
    assert Rotation.from_quat(rows[:, 4:]).as_matrix() == pytest.approx(turned[:, :3, :3], abs=1e-6)
    (tmp_path / "path.tum").write_bytes(content)
    times_s, poses = read_tum(tmp_path / "path.tum")  # `intrasplat poses` reads it, too
    assert times_s == pytest.approx(scene.frame_times_s)
    assert poses == pytest.approx(turned, abs=1e-4)


def test_after_the_clip_its_last_moment_is_shown() -> None:
    scene = random_scene()
    assert exported(scene, "points", t=7) == exported(scene, "points", t=(FRAMES - 1) / FRAMES)


def test_a_file_that_would_be_too_large_is_refused_before_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target, "MAX_EXPORT_BYTES", 3 * 12 * 11)
    with pytest.raises(LimitError, match="every=2") as refused:
        exported(random_scene(), "tracks")
    assert refused.value.field == "every"
    exported(random_scene(), "tracks", every=2)
    with pytest.raises(LimitError):
        exported(random_scene(), "depth")


@pytest.mark.parametrize(
    ("name", "options", "field", "remedy"),
    [
        ("splatz", {}, "format", "Did you mean splat?"),
        ("tracks.npz", {}, "format", "Did you mean tracks?"),
        ("qqq", {}, "format", f"Use one of: {', '.join(EXPORT_FORMATS)}."),
        ("ply", {"every": 2}, "every", "Leave it out. It takes t."),
        ("depth", {"t": 0.5}, "t", "Leave it out. It takes every."),
        ("tum", {"t": 0.0}, "t", "Leave it out. It takes none."),
        ("ply", {"colour": "red"}, "colour", "Leave it out. It takes t."),
        ("ply", {"t": -0.1}, "t", "docs/export.md lists the formats and their options."),
        ("ply", {"t": math.nan}, "t", "docs/export.md lists the formats and their options."),
        ("depth", {"every": 0}, "every", "docs/export.md lists the formats and their options."),
    ],
)
def test_what_does_not_fit_is_refused(name: str, options: dict[str, object], field: str, remedy: str) -> None:
    with pytest.raises(InputError) as refused:
        check_export(name, options)
    assert (refused.value.field, refused.value.remedy) == (field, remedy)


def test_a_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="nan"):
        target.splats_at(random_scene(), math.nan)
