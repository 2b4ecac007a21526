"""Binary glTF, read by pygltflib, and compared with what splat-transform makes of our PLY where it is installed.

`npm install -g @playcanvas/splat-transform` installs it. It writes glTF and does not read it.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pygltflib import GLTF2

from intrasplat.export import export_parts
from intrasplat.export.gltf import EXTENSION
from intrasplat.formats import ExportOptions
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.gaussians import sh_colour
from tests.intrasplat.scenes import random_scene

SPLAT_TRANSFORM = shutil.which("splat-transform")
NUMBERS = {5121: "u1", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
UP = np.array([1, -1, -1])
"""glTF's axes in OpenCV's."""


def written(path: Path, scene: TrainedScene, name: str, t: float) -> Path:
    path.write_bytes(b"".join(export_parts(scene, name, ExportOptions(t=t))))
    return path


def accessor(gltf: GLTF2, index: int) -> NDArray[np.generic]:
    found = gltf.accessors[index]
    view = gltf.bufferViews[found.bufferView]
    kind, columns = NUMBERS[found.componentType], COLUMNS[found.type]
    start = (view.byteOffset or 0) + (found.byteOffset or 0)
    return np.frombuffer(gltf.binary_blob(), kind, found.count * columns, start).reshape(found.count, columns)


def read_splats(path: Path) -> dict[str, NDArray[np.generic]]:
    """The attributes by their names without the extension's."""
    gltf = GLTF2.load(str(path))
    assert gltf.extensionsUsed == [EXTENSION]
    assert all(each is None for each in (gltf.nodes[0].matrix, gltf.nodes[0].rotation, gltf.nodes[0].scale))
    (primitive,) = gltf.meshes[0].primitives
    assert primitive.mode == 0
    extension = primitive.extensions[EXTENSION]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    named = {name: index for name, index in vars(primitive.attributes).items() if index is not None}
    return {name.removeprefix(f"{EXTENSION}:"): accessor(gltf, index) for name, index in named.items()}


def covariance(xyzw: NDArray[np.generic], scale: NDArray[np.generic]) -> NDArray[np.float64]:
    """[N, 3, 3], as the extension's page has it."""
    x, y, z, w = xyzw.astype(float).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turned = np.array(rows).transpose(2, 0, 1) * scale[:, None].astype(float)
    return turned @ turned.transpose(0, 2, 1)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_splats_are_in_metres_with_y_up(tmp_path: Path, sh_degree: int) -> None:
    scene = random_scene(count=50, sh_degree=sh_degree)
    splats = read_splats(written(tmp_path / "a.glb", scene, "gltf", 0.4))
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    mean_m = (moved.mean / scene.units_per_mm / 1000).numpy()
    np.testing.assert_allclose(splats["POSITION"], mean_m * UP, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(splats["ROTATION"].astype(float), axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(splats["OPACITY"][:, 0], moved.opacity.numpy(), rtol=1e-5)
    wxyz = torch.nn.functional.normalize(moved.quaternion, dim=-1).numpy()
    ours = covariance(wxyz[:, [1, 2, 3, 0]], (moved.scale / scene.units_per_mm / 1000).numpy())
    found = covariance(splats["ROTATION"], splats["SCALE"])
    np.testing.assert_allclose(found, np.diag(UP) @ ours @ np.diag(UP), rtol=1e-4, atol=1e-12)
    assert len([name for name in splats if name.startswith("SH_DEGREE")]) == (sh_degree + 1) ** 2


def test_colours_are_the_same_from_every_side(tmp_path: Path) -> None:
    scene = random_scene(count=50, sh_degree=3)
    splats = read_splats(written(tmp_path / "a.glb", scene, "gltf", 0.4))
    names = [f"SH_DEGREE_{degree}_COEF_{index}" for degree in range(4) for index in range(2 * degree + 1)]
    harmonics = torch.from_numpy(np.stack([splats[name] for name in names], axis=1).copy())
    direction = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    moved = scene.deformation.deform(scene.gaussians, 0.4)
    expected = sh_colour(moved.sh, direction)
    torch.testing.assert_close(sh_colour(harmonics, direction * torch.from_numpy(UP)), expected, rtol=1e-4, atol=1e-5)


def test_programs_without_the_extension_see_coloured_points(tmp_path: Path) -> None:
    path = written(tmp_path / "a.glb", random_scene(count=50), "gltf", 0.0)
    gltf, splats = GLTF2.load(str(path)), read_splats(path)
    assert not gltf.extensionsRequired
    bounds = gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION]
    np.testing.assert_allclose(bounds.min, splats["POSITION"].min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(bounds.max, splats["POSITION"].max(axis=0), rtol=1e-6)
    assert (splats["COLOR_0"].dtype, splats["COLOR_0"].shape) == (np.uint8, (50, 4))


def transform(source: Path, *arguments: str, to: Path) -> Path:
    assert SPLAT_TRANSFORM is not None
    subprocess.run([SPLAT_TRANSFORM, str(source), *arguments, str(to)], check=True, capture_output=True, timeout=120)
    return to


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="needs npm install -g @playcanvas/splat-transform")
def test_splat_transform_makes_the_same_of_our_ply(tmp_path: Path) -> None:
    scene = random_scene(count=50)
    ours = read_splats(written(tmp_path / "a.glb", scene, "gltf", 0.4))
    ply = written(tmp_path / "a.ply", scene, "ply", 0.4)
    # It takes a PLY's scene to look along +Z; ours looks along -Z, as glTF's cameras do.
    turned = transform(ply, "-s", "0.001", "-r", "0,180,0", to=tmp_path / "theirs.glb")
    theirs = read_splats(turned)
    assert ours.keys() == theirs.keys()
    order = [int(np.abs(theirs["POSITION"] - row).sum(axis=1).argmin()) for row in ours["POSITION"]]
    assert sorted(order) == list(range(50))
    for name in ("POSITION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"):
        np.testing.assert_allclose(theirs[name][order], ours[name], rtol=1e-4, atol=1e-6)
    assert np.abs(theirs["COLOR_0"][order].astype(int) - ours["COLOR_0"]).max() <= 1
    found = covariance(theirs["ROTATION"][order], theirs["SCALE"][order])
    np.testing.assert_allclose(found, covariance(ours["ROTATION"], ours["SCALE"]), rtol=1e-3, atol=1e-12)


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="needs npm install -g @playcanvas/splat-transform")
@pytest.mark.parametrize("name", ["ply", "splat"])
def test_splat_transform_reads_every_gaussian(tmp_path: Path, name: str) -> None:
    scene = random_scene(count=50)
    path = written(tmp_path / f"a.{name}", scene, name, 0.4)
    table = transform(path, to=tmp_path / "a.csv").read_text().splitlines()
    columns = [each.strip('"') for each in table[0].split(",")]
    rows = np.array([[float(number) for number in line.split(",")] for line in table[1:]])
    found = rows[:, [columns.index(axis) for axis in "xyz"]]
    mean_mm = (scene.deformation.deform(scene.gaussians, 0.4).mean / scene.units_per_mm).numpy()
    assert len(found) == 50
    distance = np.abs(found[:, None] - mean_mm).sum(axis=2)
    assert distance.min(axis=1).max() < 1e-3
    assert sorted(distance.argmin(axis=1)) == list(range(50))
