"""The PLY file, read back by a parser that knows only the format."""

from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from contract.wire.rendering import ExportName
from tests.worker.scenes import KINDS, random_scene
from worker.poses.trajectory import read_tum
from worker.scene.export import EXPORTS
from worker.scene.export.ply import export_ply
from worker.scene.export.tum import export_tum


def test_the_service_offers_the_formats_that_are_registered() -> None:
    assert get_args(ExportName) == tuple(EXPORTS)


def parse(data: bytes) -> tuple[list[str], NDArray[np.float32]]:
    """Property names and the table [N, properties] of a binary PLY of floats."""
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    return names, np.frombuffer(body, "<f4").reshape(count, len(names))


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_properties_stand_in_the_order_viewers_expect(sh_degree: int) -> None:
    names, table = parse(export_ply(random_scene(sh_degree=sh_degree), 0.0))
    rest = [f"f_rest_{index}" for index in range(3 * ((sh_degree + 1) ** 2 - 1))]
    before = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    after = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == [*before, *rest, *after]
    assert len(table) == 11


@pytest.mark.parametrize("kind", KINDS)
def test_the_state_at_t_is_written_in_millimetres(kind: str) -> None:
    scene = random_scene(kind, sh_degree=1)
    names, table = parse(export_ply(scene, 0.4))
    column = {name: table[:, index] for index, name in enumerate(names)}
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    mean_mm = (moved.mean / scene.units_per_mm).numpy()
    scale_mm = (moved.scale / scene.units_per_mm).numpy()
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(column[name], mean_mm[:, axis], rtol=1e-6)
        np.testing.assert_allclose(np.exp(column[f"scale_{axis}"]), scale_mm[:, axis], rtol=1e-5)
        assert not column[f"n{name}"].any()
    rotation = np.stack([column[f"rot_{part}"] for part in range(4)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-6)
    expected = torch.nn.functional.normalize(moved.quaternion, dim=-1).numpy()
    np.testing.assert_allclose(rotation, expected, atol=1e-6)
    np.testing.assert_array_equal(column["opacity"], moved.opacity_logit.numpy())
    for channel in range(3):
        np.testing.assert_array_equal(column[f"f_dc_{channel}"], moved.sh[:, 0, channel].numpy())
        for index in range(3):  # all of red, then green, then blue
            np.testing.assert_array_equal(
                column[f"f_rest_{3 * channel + index}"], moved.sh[:, 1 + index, channel].numpy()
            )


def test_a_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="nan"):
        export_ply(random_scene(), math.nan)


def test_a_tum_file_has_every_frames_pose_in_metres(tmp_path: Path) -> None:
    scene = random_scene()
    (tmp_path / "path.tum").write_bytes(export_tum(scene, 0.0))
    times_s, poses = read_tum(tmp_path / "path.tum")
    assert times_s == pytest.approx(scene.frame_times_s)
    assert poses == pytest.approx(scene.world_from_camera, abs=1e-4)
