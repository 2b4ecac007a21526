"""Meshes, read by trimesh: they lie where renders show the tissue, in its colours, and face the endoscope."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_dilation

from intrasplat.errors import InputError, MissingExtraError
from intrasplat.export import export_parts, surface
from intrasplat.formats import EXTRA_MODULES, ExportOptions, missing_extras
from intrasplat.outcome import scene_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from lab.phantom import PhantomSettings, make_phantom
from tests.intrasplat.export.sheet import tissue
from tests.intrasplat.phantoms import prepared, trained

T = 0.5


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    return tissue()


def read(scene: TrainedScene, name: str) -> trimesh.Trimesh:
    data = b"".join(export_parts(scene, f"mesh-{name}", ExportOptions(t=T)))
    return trimesh.load(io.BytesIO(data), file_type=name, force="mesh", process=False)


def test_vertices_lie_where_the_endoscope_sees_the_tissue(scene: TrainedScene) -> None:
    mesh, frame, k = read(scene, "ply"), render_frame(scene, T), scene.intrinsics
    assert len(mesh.faces) > 1000
    own = mesh.vertices @ np.linalg.inv(endoscope_pose(scene, T))[:3, :3].T
    own += np.linalg.inv(endoscope_pose(scene, T))[:3, 3]
    column = np.floor(k.fx * own[:, 0] / own[:, 2] + k.cx).astype(int)
    row = np.floor(k.fy * own[:, 1] / own[:, 2] + k.cy).astype(int)
    inside = (column >= 1) & (column < k.width - 1) & (row >= 1) & (row < k.height - 1)
    depth_mm = frame.depth_mm[row[inside], column[inside]]
    error_mm = np.abs(own[inside, 2] - depth_mm)[depth_mm > 0]
    pixel_mm = np.median(frame.depth_mm[frame.depth_mm > 0]) / k.fx
    assert np.median(error_mm) < 0.2 * pixel_mm
    assert np.percentile(error_mm, 95) < 1.0 * pixel_mm
    # All that it sees is covered, but for the borders.
    covered = np.zeros((k.height, k.width), bool)
    covered[row[inside], column[inside]] = True
    middle = (frame.depth_mm > 0)[6:-6, 6:-6]
    around = binary_dilation(covered, np.ones((3, 3)))  # a voxel is larger than a pixel
    assert around[6:-6, 6:-6][middle].mean() > 0.97


def test_vertices_lie_on_the_surface_that_the_gaussians_cover(scene: TrainedScene) -> None:
    mesh = read(scene, "ply")
    x, y, z = (scene.units_per_mm * mesh.vertices).T
    start = tissue().gaussians.mean[:-1, 2] - 60
    moved = scene.deformation.deform(scene.gaussians, T).mean[:-1, 2] - 60 - start  # all of it towards the camera
    middle = (np.abs(x) < 25) & (np.abs(y) < 20)
    error_mm = np.abs(z - 60 - 0.006 * (x * x + y * y) - float(moved.mean()))[middle] / scene.units_per_mm
    pixel_mm = 60 / scene.units_per_mm / scene.intrinsics.fx
    assert middle.sum() > 500
    assert np.median(error_mm) < 0.5 * pixel_mm
    assert np.percentile(error_mm, 95) < 1.0 * pixel_mm


def test_the_mesh_of_a_trained_phantom_lies_as_near_its_true_surface_as_rendered_depth_does() -> None:
    settings = PhantomSettings(width=160, height=128, frames=12, motion="breathing", tools=(), period_frames=12.0)
    clip = make_phantom(settings).depth_clip()
    trained_scene = scene_of(trained(prepared(clip, iterations=150)[0]))
    k = trained_scene.intrinsics
    for index in (0, 8):
        t = index / clip.frame_count
        data = b"".join(export_parts(trained_scene, "mesh-ply", ExportOptions(t=t)))
        mesh = trimesh.load(io.BytesIO(data), file_type="ply", force="mesh", process=False)
        pose = np.linalg.inv(endoscope_pose(trained_scene, t))
        own = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        column = np.floor(k.fx * own[:, 0] / own[:, 2] + k.cx).astype(int)
        row = np.floor(k.fy * own[:, 1] / own[:, 2] + k.cy).astype(int)
        inside = (column >= 4) & (column < k.width - 4) & (row >= 4) & (row < k.height - 4)
        true_mm = clip.depth_mm[index]
        mesh_error_mm = np.abs(own[inside, 2] - true_mm[row[inside], column[inside]])
        rendered_error_mm = np.abs(render_frame(trained_scene, t).depth_mm - true_mm)[4:-4, 4:-4]
        pixel_mm = float(np.median(true_mm)) / k.fx
        assert np.median(mesh_error_mm) < 2.0
        assert np.median(mesh_error_mm) < np.median(rendered_error_mm) + 0.5 * pixel_mm
        assert np.percentile(mesh_error_mm, 95) < np.percentile(rendered_error_mm, 95) + 0.5 * pixel_mm


def test_a_mesh_shows_its_own_moment(scene: TrainedScene) -> None:
    data = b"".join(export_parts(scene, "mesh-ply", ExportOptions(t=0.0)))
    first = trimesh.load(io.BytesIO(data), file_type="ply", force="mesh", process=False)
    moved = [
        float(np.median(scene.deformation.deform(scene.gaussians, t).mean[:, 2])) / scene.units_per_mm for t in (0, T)
    ]
    shift_mm = np.median(read(scene, "ply").vertices[:, 2]) - np.median(first.vertices[:, 2])
    assert shift_mm == pytest.approx(moved[1] - moved[0], abs=0.3)


def test_vertices_have_the_tissues_colours(scene: TrainedScene) -> None:
    mesh = read(scene, "ply")
    colour = mesh.visual.vertex_colors[:, :3].astype(int)
    right, left = mesh.vertices[:, 0] > 5, mesh.vertices[:, 0] < -5
    assert np.abs(np.median(colour[right], axis=0) - [204, 51, 51]).max() <= 3
    assert np.abs(np.median(colour[left], axis=0) - [51, 204, 51]).max() <= 3


def test_faces_look_at_the_endoscope_and_strays_are_left_out(scene: TrainedScene) -> None:
    mesh = read(scene, "ply")
    towards = endoscope_pose(scene, T)[:3, 3] - mesh.triangles_center
    assert (np.einsum("ij,ij->i", mesh.face_normals, towards) > 0).mean() > 0.99
    assert mesh.vertices[:, 2].min() > 50 / scene.units_per_mm


def test_all_formats_hold_the_same_mesh(scene: TrainedScene) -> None:
    ply, stl, glb = (read(scene, name) for name in ("ply", "stl", "glb"))
    np.testing.assert_allclose(stl.triangles, ply.triangles, rtol=1e-6)
    assert glb.faces.shape == ply.faces.shape
    np.testing.assert_allclose(glb.vertices, ply.vertices * [1e-3, -1e-3, -1e-3], rtol=1e-6)
    normals, is_sliver = stl.face_normals * [1, -1, -1], stl.area_faces < 1e-3 * np.median(stl.area_faces)
    assert is_sliver.mean() < 0.01
    np.testing.assert_allclose(glb.face_normals[~is_sliver], normals[~is_sliver], atol=1e-3)


def test_without_scikit_image_the_remedy_is_told(scene: TrainedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_extras() == ()
    monkeypatch.setitem(EXTRA_MODULES, "mesh", "no_such_module")
    monkeypatch.setattr("intrasplat.export.missing_extras", missing_extras.__wrapped__)
    with pytest.raises(MissingExtraError, match=r"intrasplat\[mesh\]"):
        read(scene, "ply")


def test_a_moment_without_tissue_is_refused() -> None:
    scene = tissue()
    away = dataclasses.replace(scene.gaussians, opacity_logit=torch.full((len(scene.gaussians),), -9.0))
    with pytest.raises(InputError, match="Nothing solid"):
        read(dataclasses.replace(scene, gaussians=away), "ply")


def test_the_volume_is_bounded(scene: TrainedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = read(scene, "ply")
    monkeypatch.setattr(surface, "MAX_VOXELS", 1_000)
    assert 0 < len(read(scene, "ply").faces) < len(fine.faces) / 2
