"""Writes a phantom as a stereo video, in StereoMIS layout, or in EndoNeRF layout; beside each the truth, in truth/:

NNNNNN.npz        depth_mm, hidden_depth_mm [H, W] float32; hidden_rgb [H, W, 3] float16 in [0, 1]; tissue, and
                  tissue_right of the right eye [H, W] bool
trajectories.npz  pixels [M, 2] (row, column) in frame 0, points_mm [T, M, 3] float32 world
novel_views.npz   frame [K], world_from_camera [K, 4, 4], rgb [K, H, W, 3] float16, depth_mm [K, H, W] float32
camera.json       the exact intrinsics, every frame's world_from_camera of the left eye and of the right
poses.tum         the left eye's path: a line `timestamp tx ty tz qx qy qz qw` a frame, in seconds and metres, as the
                  TUM RGB-D benchmark defines it; in StereoMIS layout also as groundtruth.txt, as that data set has it

No reader of stereo clips takes poses from these files. In EndoNeRF layout poses_bounds.npy gives them.

Symbols: T frames, H W pixels of one eye, M tracked points, K novel views. `hidden` is without the instrument.
VP9 video loses fine texture and PNG loses nothing, so measure against truth on the PNG layouts. With masks=False a clip
is written without masks, and its truth stays.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from intrasplat.errors import UnavailableError
from intrasplat.machine.opencv import silent_stderr
from lab.phantom.camera import orbit_pose
from lab.phantom.scene import Phantom, PhantomFrame

OnFrame = Callable[[int, int], None]  # called with (frames done, frames) after each frame

VIDEO, CALIBRATION, MASKS, TRUTH = "stereo.webm", "calibration.json", "masks.zip", "truth"
POSES, STEREOMIS_POSES = "poses.tum", "groundtruth.txt"
BRIGHT = 255
MAX_DEPTH_8_BIT_MM = 255
NOVEL_TIMES = (0.0, 0.35, 0.7)  # model times of the novel views
NOVEL_ANGLES_DEG = ((12.0, 0.0), (-12.0, 0.0), (0.0, 9.0), (8.0, -8.0))  # (yaw, pitch) about the frame's axis
BOUNDS_MARGIN = (0.9, 1.1)  # factors of the near and far bounds


def _ignore(done: int, frames: int) -> None:
    del done, frames


def write_stereo_video(phantom: Phantom, path: Path, on_frame: OnFrame = _ignore, *, masks: bool = True) -> None:
    """Folder with stereo.webm (VP9, left | right), calibration.json, masks.zip (tool = 255) and truth/.

    Raises UnavailableError when this OpenCV cannot write VP9.
    """
    settings = phantom.settings
    path.mkdir(parents=True, exist_ok=True)
    size = (2 * settings.width, settings.height)
    with silent_stderr():
        video = cv2.VideoWriter(str(path / VIDEO), cv2.VideoWriter.fourcc(*"VP90"), settings.frame_rate_hz, size)
    if not video.isOpened():
        raise UnavailableError("OpenCV cannot write VP9 here.", "Write --format stereomis instead.")
    try:
        with zipfile.ZipFile(path / MASKS, "w") if masks else nullcontext() as archive:
            for index in range(settings.frames):
                frame = phantom.frame(index)
                both = np.concatenate([frame.left, frame.right], axis=1)
                video.write(cv2.cvtColor(both, cv2.COLOR_RGB2BGR))
                if archive is not None:
                    archive.writestr(f"{index:06d}.png", _png(_white(~frame.tissue)))
                _write_frame_truth(path, index, frame)
                on_frame(index + 1, settings.frames)
    finally:
        video.release()
    calibration = phantom.settings.calibration.model_dump(exclude={"assumptions"})
    (path / CALIBRATION).write_text(json.dumps(calibration, indent=1))
    _write_clip_truth(phantom, path)


def write_stereomis(phantom: Phantom, path: Path, on_frame: OnFrame = _ignore, *, masks: bool = True) -> None:
    """StereoMIS layout: NNNNNNl.png, NNNNNNr.png, StereoCalibration.ini, groundtruth.txt, masks/NNNNNNl.png
    (tissue = 255); truth/.
    """
    for index in range(phantom.settings.frames):
        write_stereomis_frames(phantom, path, [index], _write_frame_truth, masks=masks)
        on_frame(index + 1, phantom.settings.frames)
    (path / STEREOMIS_POSES).write_text(_tum_lines(phantom))
    _write_clip_truth(phantom, path)


def write_stereomis_frames(
    phantom: Phantom,
    path: Path,
    frames: Iterable[int],
    also: Callable[[Path, int, PhantomFrame], None] = lambda path, index, frame: None,
    *,
    masks: bool = True,
) -> None:
    """Some frames of write_stereomis, and the calibration, but no truth; also(path, index, frame) adds to each."""
    (path / "masks" if masks else path).mkdir(parents=True, exist_ok=True)
    (path / "StereoCalibration.ini").write_text(_stereomis_calibration(phantom))
    for index in frames:
        frame = phantom.frame(index)
        _save(path / f"{index:06d}l.png", frame.left)
        _save(path / f"{index:06d}r.png", frame.right)
        if masks:
            _save(path / "masks" / f"{index:06d}l.png", _white(frame.tissue))
        also(path, index, frame)


def write_endonerf(phantom: Phantom, path: Path, on_frame: OnFrame = _ignore, *, masks: bool = True) -> None:
    """EndoNeRF layout: images/ depth/ (8-bit mm) masks/ (tool = 255) poses_bounds.npy; truth/."""
    for folder in ("images", "depth", *(["masks"] if masks else [])):
        (path / folder).mkdir(parents=True, exist_ok=True)
    nearest, farthest = np.inf, 0.0
    for index in range(phantom.settings.frames):
        frame, name = phantom.frame(index), f"{index:06d}"
        _save(path / "images" / f"{name}.png", frame.left)
        _save(path / "depth" / f"{name}.png", np.clip(np.rint(frame.depth_mm), 0, MAX_DEPTH_8_BIT_MM).astype(np.uint8))
        if masks:
            _save(path / "masks" / f"{name}.png", _white(~frame.tissue))
        _write_frame_truth(path, index, frame)
        seen = frame.depth_mm[frame.depth_mm > 0]
        nearest, farthest = min(nearest, float(seen.min())), max(farthest, float(seen.max()))
        on_frame(index + 1, phantom.settings.frames)
    bounds = (nearest * BOUNDS_MARGIN[0], farthest * BOUNDS_MARGIN[1])
    np.save(path / "poses_bounds.npy", _poses_bounds(phantom, bounds))
    _write_clip_truth(phantom, path)


def _stereomis_calibration(phantom: Phantom) -> str:
    """Both eyes' intrinsics; the right eye's section holds rotation R and translation T (mm) from left to right."""
    camera = phantom.settings.intrinsics
    lines = []
    for section, shift_mm in (("StereoLeft", 0.0), ("StereoRight", -phantom.settings.baseline_mm)):
        values: dict[str, float] = {"res_x": camera.width, "res_y": camera.height, "fc_x": camera.fx, "fc_y": camera.fy}
        # in this file pixel centres are at whole numbers, as in OpenCV
        values |= {"cc_x": camera.cx - 0.5, "cc_y": camera.cy - 0.5}
        values |= {f"kc_{i}": 0.0 for i in range(5)}
        values |= {f"R_{i}": float(i % 4 == 0) for i in range(9)}
        values |= {"T_0": shift_mm, "T_1": 0.0, "T_2": 0.0}
        lines += [f"[{section}]", *(f"{key}={value:.9g}" for key, value in values.items()), ""]
    return "\n".join(lines)


def _poses_bounds(phantom: Phantom, bounds_mm: tuple[float, float]) -> NDArray[np.float64]:
    """[T, 17]: camera-to-world [right, up, back | t | (H, W, f)] of OpenGL row by row, then near and far in mm."""
    camera = phantom.settings.intrinsics
    rows = []
    for pose in _poses(phantom):
        opengl = pose[:3, :4] * np.array([1.0, -1.0, -1.0, 1.0])
        size = np.array([[camera.height], [camera.width], [camera.fx]])
        rows.append(np.concatenate([np.concatenate([opengl, size], axis=1).ravel(), bounds_mm]))
    return np.stack(rows)


def _poses(phantom: Phantom) -> NDArray[np.float64]:
    return np.stack([phantom.world_from_camera(index) for index in range(phantom.settings.frames)])


def _tum_lines(phantom: Phantom) -> str:
    """The left eye's path as a TUM file."""
    lines = ["# timestamp tx ty tz qx qy qz qw; world_from_camera of the left eye, seconds and metres"]
    for index, pose in enumerate(_poses(phantom)):
        metres, turn = pose[:3, 3] / 1000, Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        values = (index / phantom.settings.frame_rate_hz, *metres, *turn)
        lines.append(" ".join(f"{value:.9f}" for value in values))
    return "\n".join(lines) + "\n"


def _write_frame_truth(path: Path, index: int, frame: PhantomFrame) -> None:
    (path / TRUTH).mkdir(exist_ok=True)
    np.savez_compressed(
        path / TRUTH / f"{index:06d}.npz",
        depth_mm=frame.depth_mm,
        hidden_depth_mm=frame.hidden_depth_mm,
        hidden_rgb=frame.hidden_rgb.astype(np.float16),
        tissue=frame.tissue,
        tissue_right=frame.tissue_right,
    )


def _write_clip_truth(phantom: Phantom, path: Path) -> None:
    """Write what belongs to no single frame."""
    tracks = phantom.trajectories()
    np.savez_compressed(
        path / TRUTH / "trajectories.npz", pixels=tracks.pixels, points_mm=tracks.points_mm.astype(np.float32)
    )
    _write_novel_views(phantom, path / TRUTH / "novel_views.npz")
    frames = range(phantom.settings.frames)
    camera = {
        "intrinsics": phantom.settings.intrinsics.numbers(),
        "world_from_camera": _poses(phantom).tolist(),
        "world_from_right_camera": [phantom.world_from_right(index).tolist() for index in frames],
    }
    (path / TRUTH / "camera.json").write_text(json.dumps(camera, indent=1))
    (path / TRUTH / POSES).write_text(_tum_lines(phantom))


def _write_novel_views(phantom: Phantom, path: Path) -> None:
    """Write a view at each novel time from each novel angle."""
    frames = [int(t * phantom.settings.frames) for t in NOVEL_TIMES for _ in NOVEL_ANGLES_DEG]
    turns = [orbit_pose(yaw_deg, pitch_deg) for _ in NOVEL_TIMES for yaw_deg, pitch_deg in NOVEL_ANGLES_DEG]
    poses = [phantom.world_from_camera(frame) @ turn for frame, turn in zip(frames, turns, strict=True)]
    views = [phantom.render(frame, pose) for frame, pose in zip(frames, poses, strict=True)]
    np.savez_compressed(
        path,
        frame=np.array(frames, dtype=np.int32),
        world_from_camera=np.stack(poses),
        rgb=np.stack([rgb for rgb, _ in views]).astype(np.float16),
        depth_mm=np.stack([depth_mm for _, depth_mm in views]),
    )


def _white(where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(where, np.uint8(BRIGHT), np.uint8(0))


def _png(image: NDArray[np.uint8]) -> bytes:
    """A PNG file of grey or RGB pixels."""
    ordered = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    encoded, data = cv2.imencode(".png", ordered)
    if not encoded:
        raise UnavailableError("OpenCV cannot write PNG here.", "Install opencv-contrib-python-headless again.")
    return bytes(data)


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.write_bytes(_png(image))
