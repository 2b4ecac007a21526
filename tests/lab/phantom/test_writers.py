"""The phantom's files against their readers, and the truth beside them."""

from __future__ import annotations

import argparse
import json
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intrasplat.clip import open_clip
from intrasplat.clip.types import DepthClip, StereoClip
from intrasplat.errors import InputError
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.options import ClipOptions, ReconstructionOptions
from intrasplat.stereo.opening import ClipPaths, open_with_depth
from lab.phantom import Phantom, PhantomSettings, make_phantom, write_endonerf, write_stereo_video, write_stereomis
from lab.phantom.command import add_cli_arguments, run_cli


@cache
def short() -> Phantom:
    return make_phantom(PhantomSettings(96, 80, 3, "pull", camera=("swing",)))


def test_stereo_video_reads_back_close_with_its_calibration_and_masks(tmp_path: Path) -> None:
    scene = short()
    write_stereo_video(scene, tmp_path)
    clip = open_clip(tmp_path / "stereo.webm", masks=tmp_path / "masks.zip", options=ClipOptions(mask_polarity="tool"))
    assert isinstance(clip, StereoClip)
    assert (clip.frame_count, clip.height, clip.width) == (3, 80, 96)
    assert clip.tissue is not None
    for index, (left, right) in enumerate(clip.pairs()):
        frame = scene.frame(index)
        np.testing.assert_array_equal(clip.tissue[index], frame.tissue)
        assert np.abs(left.astype(float) - frame.left).mean() < 8
        assert np.abs(right.astype(float) - frame.right).mean() < 8
    calibration = json.loads((tmp_path / "calibration.json").read_text())
    assert calibration["model"] == "rectified"
    assert calibration["fx_px"] == pytest.approx(0.89 * 96)
    with zipfile.ZipFile(tmp_path / "masks.zip") as masks:
        tool = cv2.imdecode(np.frombuffer(masks.read("000001.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(tool == 255, ~scene.frame(1).tissue)


def test_stereomis_reads_back_exactly_with_tissue_white(tmp_path: Path) -> None:
    scene = short()
    write_stereomis(scene, tmp_path)
    clip = open_clip(tmp_path)
    assert isinstance(clip, StereoClip)
    assert clip.tissue is not None
    for index, (left, right) in enumerate(clip.pairs()):
        frame = scene.frame(index)
        np.testing.assert_array_equal(left, frame.left)
        np.testing.assert_array_equal(right, frame.right)
        np.testing.assert_array_equal(clip.tissue[index], frame.tissue)
    white = cv2.imread(str(tmp_path / "masks" / "000000l.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(white == 255, scene.frame(0).tissue)


def test_endonerf_reads_back_with_poses_and_truth(tmp_path: Path) -> None:
    scene = short()
    write_endonerf(scene, tmp_path)
    clip = open_clip(tmp_path)
    assert isinstance(clip, DepthClip)
    frame = scene.frame(2)
    np.testing.assert_array_equal(clip.rgb[2], frame.left)
    np.testing.assert_array_equal(clip.tissue[2], frame.tissue)
    np.testing.assert_allclose(clip.depth_mm[2], frame.depth_mm, atol=0.501)
    np.testing.assert_allclose(clip.world_from_camera[2], frame.world_from_camera, atol=1e-9)
    assert clip.intrinsics.fx == pytest.approx(scene.settings.intrinsics.fx)
    truth = np.load(tmp_path / "truth" / "000002.npz")
    np.testing.assert_array_equal(truth["hidden_depth_mm"], frame.hidden_depth_mm)
    np.testing.assert_allclose(truth["hidden_rgb"], frame.hidden_rgb, atol=1e-3)
    views = np.load(tmp_path / "truth" / "novel_views.npz")
    rgb, depth_mm = scene.render(int(views["frame"][-1]), views["world_from_camera"][-1])
    np.testing.assert_array_equal(views["depth_mm"][-1], depth_mm)
    np.testing.assert_allclose(views["rgb"][-1], rgb, atol=1e-3)
    tracks = np.load(tmp_path / "truth" / "trajectories.npz")
    assert tracks["points_mm"].shape == (3, len(tracks["pixels"]), 3)


@pytest.mark.parametrize("write", [write_stereo_video, write_stereomis, write_endonerf])
def test_every_layout_has_the_truth_beside_it(write: Callable[[Phantom, Path], None], tmp_path: Path) -> None:
    scene = short()
    write(scene, tmp_path)
    frame = scene.frame(1)
    truth = np.load(tmp_path / "truth" / "000001.npz")
    np.testing.assert_array_equal(truth["depth_mm"], frame.depth_mm)
    np.testing.assert_array_equal(truth["tissue_right"], frame.tissue_right)
    camera = json.loads((tmp_path / "truth" / "camera.json").read_text())
    left, right = (np.array(camera[name][2]) for name in ("world_from_camera", "world_from_right_camera"))
    np.testing.assert_allclose(left, scene.world_from_camera(2))
    assert (np.linalg.inv(left) @ right)[0, 3] == pytest.approx(scene.settings.baseline_mm)
    views = np.load(tmp_path / "truth" / "novel_views.npz")
    assert views["rgb"].shape[1:] == (80, 96, 3)
    path = np.loadtxt(tmp_path / "truth" / "poses.tum")
    np.testing.assert_allclose(path[:, 0], np.arange(3) / scene.settings.frame_rate_hz)
    np.testing.assert_allclose(path[2, 1:4], left[:3, 3] / 1000, atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(path[2, 4:]).as_matrix(), left[:3, :3], atol=1e-8)


@pytest.mark.parametrize("write", [write_stereo_video, write_stereomis])
def test_a_stereo_clip_has_its_poses_as_truth_alone(write: Callable[[Phantom, Path], None], tmp_path: Path) -> None:
    write(short(), tmp_path)
    assert (tmp_path / "groundtruth.txt").exists() == (write is write_stereomis)
    clip = tmp_path / "stereo.webm" if write is write_stereo_video else tmp_path
    calibration = None if write is write_stereomis else tmp_path / "calibration.json"
    depth = open_with_depth(ClipPaths(clip, calibration=calibration), ReconstructionOptions(), Hooks(), Timings())
    np.testing.assert_array_equal(depth.world_from_camera, np.tile(np.eye(4), (3, 1, 1)))


@pytest.mark.parametrize("write", [write_stereo_video, write_stereomis, write_endonerf])
def test_a_clip_without_masks_reads_back_as_tissue_alone_and_keeps_its_truth(
    write: Callable[..., None], tmp_path: Path
) -> None:
    write(short(), tmp_path, masks=False)
    clip = open_clip(tmp_path / "stereo.webm" if write is write_stereo_video else tmp_path)
    if isinstance(clip, DepthClip):
        assert clip.tissue.all()
    else:
        assert clip.tissue is None
    truth = np.load(tmp_path / "truth" / "000001.npz")
    np.testing.assert_array_equal(truth["tissue"], short().frame(1).tissue)


def test_the_command_writes_a_clip_and_refuses_a_folder_in_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    add_cli_arguments(parser)
    words = ["--width", "96", "--height", "80", "--frames", "2", "--motion", "still", "--no-masks"]
    words += ["--camera", "pan", "shake", "--tools", "steel", "dark"]
    args = parser.parse_args([*words, "--format", "stereomis", "--out", str(tmp_path / "clip")])
    assert run_cli(args) == 0
    assert "2 frames of 96x80 (still+pan+shake)" in capsys.readouterr().out
    assert (tmp_path / "clip" / "000001r.png").exists()
    assert not (tmp_path / "clip" / "masks").exists()
    with pytest.raises(InputError, match="not an empty folder"):
        run_cli(args)
