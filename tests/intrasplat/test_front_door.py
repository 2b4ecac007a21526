"""`import intrasplat`: few names, light, documented; its examples run, from arrays in memory and from files."""

from __future__ import annotations

import doctest
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import intrasplat as isp
from intrasplat.clip.types import DepthClip
from intrasplat.poses import StoredPoses
from intrasplat.poses.trajectory import write_tum
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video
from tests.intrasplat.phantoms import phantom_clip

MAX_NAMES = 25


def test_there_are_few_names_and_each_is_there() -> None:
    assert len(isp.__all__) <= MAX_NAMES
    assert len(set(isp.__all__)) == len(isp.__all__)
    assert [name for name in isp.__all__ if not hasattr(isp, name)] == []
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = isp.nothing


def test_each_name_is_documented() -> None:
    silent = [name for name in isp.__all__ if name != "__version__" and not inspect.getdoc(getattr(isp, name))]
    assert silent == []


def test_importing_it_loads_nothing_heavy() -> None:
    program = "import sys, intrasplat; print(*({'torch', 'numpy', 'numba', 'cv2', 'pydantic'} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert loaded.stdout.split() == []


@pytest.fixture(scope="module")
def matched() -> DepthClip:
    return phantom_clip(frames=10, noise=False)


@pytest.fixture(scope="module")
def scene(matched: DepthClip) -> isp.Scene:
    clip = isp.read_clip(matched.rgb, depth_mm=matched.depth_mm, intrinsics=matched.intrinsics)
    return isp.reconstruct(clip, iterations=4, device="cpu")


def test_the_examples_of_the_docstrings_run(matched: DepthClip, scene: isp.Scene, tmp_path: Path) -> None:
    names: dict[str, Any] = {
        "isp": isp,
        "scene": scene,
        "frames": matched.rgb,
        "depth_mm": matched.depth_mm,
        "camera": matched.intrinsics,
        "tmp": tmp_path,
    }
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    tried = {}
    for name in ("read_clip", "Clip", "reconstruct", "load", "Scene", "orbit"):
        public = getattr(isp, name)
        module = sys.modules[public.__module__]
        found = [each for each in finder.find(public, name, module=module, globs=names) if each.examples]
        tried[name] = sum(len(each.examples) for each in found)
        for each in found:
            assert runner.run(each, clear_globs=False).failed == 0, each.name
    assert min(tried.values()) > 0, tried


def test_masks_and_poses_in_memory_are_taken_as_given(matched: DepthClip) -> None:
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(3.0, 5.0, 10)
    clip = isp.read_clip(
        matched.rgb, depth_mm=matched.depth_mm, masks=~matched.tissue, poses=poses, intrinsics=matched.intrinsics
    )
    assert isinstance(clip.source, DepthClip)
    assert np.array_equal(clip.source.tissue, matched.tissue)
    assert isinstance(clip.poses, StoredPoses)
    np.testing.assert_array_equal(clip.poses.matrices, poses)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"depth_mm": np.ones((10, 8, 8))}, "depth_mm"),
        ({"depth_mm": np.full((10, 80, 96), np.nan)}, "depth_mm"),
        ({"depth_mm": np.zeros((10, 80, 96))}, "depth_mm"),
        ({"intrinsics": None}, "intrinsics"),
        ({"intrinsics": isp.Intrinsics(width=9, height=8, fx=9, fy=9, cx=4, cy=4)}, "intrinsics"),
        ({"masks": np.ones((10, 80, 96), np.uint8)}, "masks"),
        ({"masks": "masks.zip"}, "masks"),
        ({"poses": np.zeros((10, 4, 4))}, "poses"),
        ({"poses": np.eye(4)}, "poses"),
        ({"frame_times_s": np.zeros(10)}, "frame_times_s"),
        ({"calibration": "calibration.json"}, "calibration"),
        ({"right": np.zeros((10, 80, 96, 3), np.uint8)}, "right"),
        ({"source": np.zeros((10, 80, 96), np.uint8)}, "source"),
        ({"source": "nowhere.webm"}, "depth_mm"),
        ({"source": np.zeros((2, 80, 96, 3), np.uint8), "depth_mm": None, "intrinsics": None}, "right"),
        ({"layout": "sideways"}, "options.layout"),
    ],
)
def test_what_cannot_be_used_is_named(matched: DepthClip, changes: dict[str, Any], field: str) -> None:
    given = {"source": matched.rgb, "depth_mm": matched.depth_mm, "intrinsics": matched.intrinsics, **changes}
    with pytest.raises(isp.InputError) as refused:
        isp.read_clip(**given)
    assert refused.value.field == field
    assert refused.value.remedy


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(isp.InputError) as refused:
        isp.read_clip("nowhere.webm")
    assert refused.value.field == "source"


@pytest.mark.parametrize(
    ("options", "field"),
    [({"method": "quick"}, "method"), ({"budget_s": -1.0}, "budget_s"), ({"eye": "left"}, "eye")],
)
def test_an_option_that_there_is_not_is_named(matched: DepthClip, options: dict[str, Any], field: str) -> None:
    with pytest.raises(isp.InputError) as refused:
        isp.reconstruct(matched, **options)
    assert refused.value.field == field


def test_a_stereo_clip_of_files_and_the_same_frames_in_memory_give_the_same_scene(tmp_path: Path) -> None:
    phantom = make_phantom(PhantomSettings(frames=10, width=128, height=96, motion="breathing"))
    write_stereo_video(phantom, tmp_path)
    given = {"calibration": tmp_path / "calibration.json", "masks": tmp_path / "masks.zip"}
    clip = isp.read_clip(tmp_path / "stereo.webm", **given)
    steps: list[str] = []
    scene = isp.reconstruct(clip, iterations=3, device="cpu", on_progress=lambda now: steps.append(str(now)))
    assert any(each.startswith("train") for each in steps)
    view = scene.render(0.5, isp.orbit(5, 0), width=64)
    assert view.rgb.shape == (48, 64, 3)
    assert np.isfinite(view.confidence).all()
    eyes = decoded(tmp_path / "stereo.webm")
    in_memory = isp.read_clip(
        eyes[:, :, :128], np.ascontiguousarray(eyes[:, :, 128:]), calibration=given["calibration"], mask_source="none"
    )
    again = isp.reconstruct(in_memory, iterations=3, device="cpu")
    assert again.frame_count == scene.frame_count
    assert again.report.psnr_tissue_db == pytest.approx(scene.report.psnr_tissue_db, abs=3)


def decoded(path: Path) -> NDArray[np.uint8]:
    """[T, H, W, 3] every frame of a video, RGB."""
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return np.stack(frames)


def test_a_scene_is_not_written_over_another(scene: isp.Scene, tmp_path: Path) -> None:
    scene.save(tmp_path / "scene")
    with pytest.raises(isp.InputError, match="there already"):
        scene.save(tmp_path / "scene")
    with pytest.raises(isp.InputError, match="finished scene"):
        isp.reconstruct(phantom_clip(), out=tmp_path / "scene")
    with pytest.raises(isp.InputError, match="no scene"):
        isp.load(tmp_path)
    with pytest.raises(isp.InputError, match="known ending"):
        scene.export(tmp_path / "scene.obj")


def test_a_pose_may_be_a_matrix_or_the_text_of_the_api(scene: isp.Scene) -> None:
    turned = scene.render(0.0, "orbit:8,0,1").rgb
    assert np.array_equal(scene.render(0.0, isp.orbit(8, 0)).rgb, turned)
    assert np.array_equal(scene.render(0.0, np.eye(4)).rgb, scene.render(0.0).rgb)
    with pytest.raises(isp.InputError, match="pose"):
        scene.render(0.0, np.eye(3))


def test_poses_of_frames_of_both_eyes_are_given_as_array_or_file(tmp_path: Path) -> None:
    phantom = make_phantom(PhantomSettings(width=96, height=80, frames=14, tools=(), camera=("pan",)))
    frames = [phantom.frame(index) for index in range(14)]
    left, right = (np.stack([getattr(frame, name) for frame in frames]) for name in ("left", "right"))
    poses = np.stack([phantom.world_from_camera(index) for index in range(14)])
    calibration = phantom.settings.calibration.model_dump()
    (tmp_path / "poses.json").write_text(str(poses.tolist()))
    for given in (poses, tmp_path / "poses.json"):
        clip = isp.read_clip(left, right, calibration=calibration, poses=given).with_depth()
        assert np.allclose(clip.world_from_camera, poses, atol=1e-6)
        assert clip.poses is not None
        assert clip.poses.source == "given"
    with pytest.raises(isp.InputError) as refused:
        isp.read_clip(left, right, calibration=calibration, poses=2 * poses)
    assert refused.value.field == "poses"
    tum, moments_s = tmp_path / "robot.tum", np.append(0.03 * np.arange(14), 0.59)
    write_tum(tum, moments_s, np.concatenate([poses, poses[-1:]]))
    with pytest.raises(isp.InputError, match="times are not known"):  # 30 frames a second are assumed
        isp.read_clip(left, right, calibration=calibration, poses=tum).with_depth()
    isp.read_clip(left, right, calibration=calibration, poses=tum, frame_times_s=np.arange(14) / 30).with_depth()
