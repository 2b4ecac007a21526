"""A recorded clip, from files or from arrays in memory: `read_clip`.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import ClipLimits, DepthClip, StereoClip
from intrasplat.clip.calibration import load_calibration
from intrasplat.clip.frame_times import assumed_times
from intrasplat.clip.given_field import Mask, read_field, with_field
from intrasplat.errors import InputError
from intrasplat.intake.calibration.fit import fitted
from intrasplat.intake.calibration.text import checked_calibration
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.machine.hooks import Hooks, Progress, ignore
from intrasplat.machine.timing import Timings
from intrasplat.names import Layout, MaskPolarity, MaskSource, PoseConvention
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import ClipOptions, ReconstructionOptions, parse_options
from intrasplat.pipeline import open_with_poses
from intrasplat.poses import StoredPoses
from intrasplat.poses.agreement import Convention
from intrasplat.poses.pose_file import rigid
from intrasplat.report import CameraPoses, Masks
from intrasplat.splat.backend import choose_device
from intrasplat.stereo import ClipPaths, match_eyes
from intrasplat.train.request import ReconstructionRequest

FilePath = str | os.PathLike[str]
CERTAIN = 255
"""The confidence of a depth that the caller gave (DepthClip.depth_confidence)."""


@dataclass(frozen=True, eq=False)
class StereoFrames:
    """Frames of both eyes in memory, and the calibration of the eyes."""

    clip: StereoClip
    calibration: StereoCalibration


@dataclass(frozen=True, eq=False)
class Clip:
    """A recorded clip, not yet decoded, rectified or matched; `read_clip` returns it.

    source     its files, its frames of both eyes, or its frames with depth
    options    layout of its files
    segmenter  an ONNX file that finds instruments where there are no masks; None: they are found by colour and depth
    poses      of the camera, a file or as stored; None: as source has them
    """

    source: ClipPaths | StereoFrames | DepthClip
    options: ClipOptions = field(default_factory=ClipOptions)
    segmenter: Path | None = None
    poses: Path | StoredPoses | None = None

    def with_depth(
        self,
        *,
        holdout: str = "every8",
        device: str = "auto",
        on_progress: Callable[[Progress], None] = ignore,
        options: ReconstructionOptions | None = None,
    ) -> DepthClip:
        """Decode the clip, rectify and match its eyes, and find its camera's path.

        Args:
            holdout: held-out frames, which no stage here measures on: every8, blocks8, none, or numbers such as "1,9".
                Pass the same to `reconstruct`.
            device: auto, cpu or cuda.
            on_progress: receives a Progress between parts of the work.
            options: all options of a reconstruction, instead of holdout.

        Returns:
            The frames with rgb [T, H, W, 3] uint8, depth_mm [T, H, W] float32 (0: unknown), tissue [T, H, W] bool and
            world_from_camera [T, 4, 4] float64 in mm.

        Raises:
            InputError: a file, an array or an option cannot be used.
            UnavailableError: the device is missing, or the disk is full.

        Example:
            >>> matched = isp.read_clip(frames, depth_mm=depth_mm, intrinsics=camera).with_depth(holdout="none")
            >>> matched.depth_mm.shape == matched.tissue.shape
            True
        """
        chosen = options or parse_options(ReconstructionOptions, {**self.options.model_dump(), "holdout": holdout})
        hooks, timings, where = Hooks(on_progress), Timings(), choose_device(device)
        source = self.source
        if isinstance(source, StereoFrames):
            source = match_eyes(
                source.clip,
                source.calibration,
                chosen.holdout,
                hooks,
                timings,
                skip_redundant=chosen.use_frames == "new",
                device=where.kind,
                depth_range_mm=(chosen.min_depth_mm, chosen.max_depth_mm),
                fov=chosen.fov,
                mask_source=chosen.mask_source,
                segmenter=self.segmenter,
            )
        paths = source if isinstance(source, ClipPaths) else ClipPaths(Path())
        request = ReconstructionRequest(
            clip=source if isinstance(source, DepthClip) else paths.clip,
            right=paths.right,
            calibration=paths.calibration,
            masks=paths.masks,
            fov_mask=paths.fov_mask,
            options=chosen,
            segmenter=self.segmenter,
            poses=self.poses,
        )
        return open_with_poses(request, hooks, timings, where)


def read_clip(
    source: FilePath | NDArray[np.uint8],
    right: FilePath | NDArray[np.uint8] | None = None,
    *,
    calibration: FilePath | Mapping[str, Any] | None = None,
    masks: FilePath | NDArray[np.bool_] | None = None,
    fov_mask: FilePath | NDArray[np.bool_] | None = None,
    depth_mm: NDArray[np.floating[Any]] | None = None,
    poses: FilePath | NDArray[np.floating[Any]] | None = None,
    intrinsics: Intrinsics | None = None,
    frame_times_s: NDArray[np.floating[Any]] | None = None,
    segmenter: FilePath | None = None,
    layout: Layout = "auto",
    mask_polarity: MaskPolarity = "auto",
    mask_source: MaskSource = "auto",
    pose_convention: PoseConvention = "opengl",
) -> Clip:
    """A recorded clip from files, or from arrays in memory: both eyes, or one eye with its depth.

    Files are decoded later, by a process without network, when `reconstruct` or `Clip.with_depth` reads them.

    Args:
        source: a video, folder or zip of both eyes or, with `right`, of the left one; or [T, H, W, 3] uint8 RGB.
        right: the right eye, likewise.
        calibration: of both eyes, a file or the values of our JSON (docs/input.md). Needed for stereo frames.
        masks: zip, folder or video of instruments; or [T, H, W] bool, True where an instrument hides the tissue.
        fov_mask: PNG, white where the left eye shows the scene; or [H, W] bool, True there; as recorded, before
            rectification. Both eyes may be packed side by side; else the right eye's field is found. None: both are
            found. It does not go with fov="all" of reconstruct.
        depth_mm: [T, H, W] camera z in mm, 0 where it is unknown. Only for frames of one eye in memory.
        poses: [T, 4, 4] world_from_camera in mm, OpenCV axes; or a file of them (docs/conventions.md). None: with
            depth_mm the camera is fixed, else its path is found. Poses are checked against the pictures.
        intrinsics: the camera; required with depth_mm.
        frame_times_s: [T] seconds from the first frame; None: 30 frames a second. Only with frames in memory.
        segmenter: an ONNX file that finds instruments where there are no masks.
        layout, mask_polarity, mask_source, pose_convention: see docs/input.md; "auto" detects the value.

    Raises:
        InputError: a file is missing, or arrays do not fit each other; it names the argument and the remedy.
        LimitError: the arrays are larger than this machine accepts.

    Example:
        >>> clip = isp.read_clip(frames, depth_mm=depth_mm, intrinsics=camera)
        >>> clip.source.frame_count == len(frames)
        True
    """
    chosen = parse_options(
        ClipOptions,
        {
            "layout": layout,
            "mask_polarity": mask_polarity,
            "mask_source": mask_source,
            "pose_convention": pose_convention,
        },
    )
    network = _existing(segmenter, "segmenter")
    field_of_view = _field(fov_mask)
    if isinstance(source, np.ndarray):
        times_s, assumed = _times_s(frame_times_s, source)
        if depth_mm is not None:
            _refuse("right", right, "frames with depth_mm are of one eye", "Leave it out, or leave out depth_mm.")
            _refuse("calibration", calibration, "frames with depth_mm have intrinsics", "Give intrinsics instead.")
            clip = _depth_clip(source, depth_mm, masks, intrinsics, times_s, assumed, rests=poses is None)
            clip = clip if field_of_view is None else with_field(clip, _mask(field_of_view))
            return Clip(clip, chosen, network, _stored(poses))
        _refuse("intrinsics", intrinsics, "the cameras of a stereo clip are in its calibration", "Leave them out.")
        frames = _stereo_frames(source, right, calibration, masks, times_s, assumed)
        if field_of_view is not None:
            frames = replace(frames, clip=with_field(frames.clip, _mask(field_of_view)))
        return Clip(frames, chosen, network, _stored(poses))
    in_memory = {"depth_mm": depth_mm, "intrinsics": intrinsics, "frame_times_s": frame_times_s}
    for name, value in in_memory.items():
        _refuse(name, value, "it goes with frames in memory alone", "Leave it out; files bring their own.")
    for name, file in (("right", right), ("masks", masks)):
        if isinstance(file, np.ndarray):
            raise InputError(name, "it is an array, but the clip is a file.", "Give a file, or the clip's frames too.")
    if isinstance(calibration, Mapping):
        raise InputError("calibration", "it is a mapping, but the clip is a file.", "Give the calibration's file.")
    paths = ClipPaths(
        _path(source, "source"), _existing(right, "right"), _existing(calibration, "calibration"),
        _existing(masks, "masks"), field_of_view,
    )  # fmt: skip
    return Clip(paths, chosen, network, _stored(poses))


def _stored(poses: FilePath | NDArray[Any] | None) -> Path | StoredPoses | None:
    if not isinstance(poses, np.ndarray):
        return _existing(poses, "poses")
    return StoredPoses(rigid(poses, "poses"), None, "poses", Convention())


def _field(fov_mask: FilePath | NDArray[np.bool_] | None) -> Path | Mask | None:
    if not isinstance(fov_mask, np.ndarray):
        return _existing(fov_mask, "fov_mask")
    if fov_mask.dtype != np.bool_ or fov_mask.ndim != 2:
        raise _shape_error("fov_mask", fov_mask, "[H, W] bool, True where the picture shows the scene")
    return fov_mask


def _mask(fov_mask: Path | Mask) -> Mask:
    return read_field(fov_mask, ClipLimits()) if isinstance(fov_mask, Path) else fov_mask


def _path(path: FilePath, field: str) -> Path:
    if not Path(path).exists():
        raise InputError(field, f"there is no {os.fspath(path)!r}.", "Name a file or folder that is there.")
    return Path(path)


def _existing(path: Any, field: str) -> Path | None:
    return None if path is None else _path(path, field)


def _refuse(field: str, value: object, why: str, remedy: str) -> None:
    if value is not None:
        raise InputError(field, f"{why}.", remedy)


def _shape_error(field: str, array: NDArray[Any], wanted: str) -> InputError:
    return InputError(field, f"it is {array.dtype} {list(array.shape)}.", f"Give {wanted}.")


def _check_frames(rgb: NDArray[Any], field: str) -> None:
    if rgb.dtype != np.uint8 or rgb.ndim != 4 or rgb.shape[-1] != 3 or not rgb.shape[0]:
        raise _shape_error(field, rgb, "[T, H, W, 3] uint8, RGB, of at least one frame")


def _times_s(given: NDArray[Any] | None, rgb: NDArray[Any]) -> tuple[NDArray[np.float64], tuple[Notice, ...]]:
    """Times [T] in seconds from the first frame, and the notice of times that are assumed."""
    _check_frames(rgb, "source")
    if given is None:
        times_s, notice = assumed_times(len(rgb))
        return times_s, (notice,)
    times_s = np.asarray(given, np.float64)
    if times_s.shape != (len(rgb),) or not np.isfinite(times_s).all() or not (np.diff(times_s) > 0).all():
        raise _shape_error("frame_times_s", times_s, f"[{len(rgb)}] finite seconds that rise")
    return times_s - times_s[0], ()


def _tissue(masks: FilePath | NDArray[np.bool_] | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    if masks is None:
        return None
    if not isinstance(masks, np.ndarray):
        raise InputError("masks", "they are a file, but the clip is in memory.", "Give an array, or the clip's file.")
    if masks.dtype != np.bool_ or masks.shape != shape:
        raise _shape_error("masks", masks, f"{list(shape)} bool, True where an instrument hides the tissue")
    return ~masks


def _masks_of(tissue: NDArray[np.bool_] | None) -> Masks:
    return Masks(source="none") if tissue is None else Masks(source="given", share=float(1 - tissue.mean()))


def _depth_clip(
    rgb: NDArray[np.uint8],
    depth_mm: NDArray[Any],
    masks: FilePath | NDArray[np.bool_] | None,
    intrinsics: Intrinsics | None,
    times_s: NDArray[np.float64],
    assumed: tuple[Notice, ...],
    *,
    rests: bool,
) -> DepthClip:
    count, height, width = rgb.shape[:3]
    ClipLimits().check_frame("source", "the clip", width, height)
    ClipLimits().check_clip("source", "the clip", count, width, height, eyes=1, has_depth=True)
    if intrinsics is None:
        raise InputError("intrinsics", "frames with depth_mm need a camera.", "Give an intrasplat.Intrinsics.")
    if (intrinsics.width, intrinsics.height) != (width, height):
        problem = f"they are of {intrinsics.width}x{intrinsics.height} pixels, the frames are {width}x{height}."
        raise InputError("intrinsics", problem, "Give intrinsics.resized(width, height).")
    depth = np.asarray(depth_mm, np.float32)
    if depth.shape != rgb.shape[:3] or not np.isfinite(depth).all() or (depth < 0).any():
        raise _shape_error("depth_mm", depth, f"{list(rgb.shape[:3])} finite mm, 0 where the depth is unknown")
    tissue = _tissue(masks, rgb.shape[:3])
    visible = np.ones(rgb.shape[:3], np.bool_) if tissue is None else tissue
    if not (visible & (depth > 0)).any():
        raise InputError("depth_mm", "no pixel of tissue has a depth.", "Give camera z in mm.")
    return DepthClip(
        rgb=np.ascontiguousarray(rgb),
        tissue=visible,
        depth_mm=depth,
        depth_confidence=np.where(depth > 0, np.uint8(CERTAIN), np.uint8(0)),
        intrinsics=intrinsics,
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        frame_times_s=times_s,
        masks=_masks_of(tissue),
        poses=CameraPoses(source="fixed") if rests else None,
        assumptions=(
            Notice.info(NoticeCode.LAYOUT, "layout: frames and depth in memory"),
            Notice.info(NoticeCode.POSES, f"poses: {'none were given: a fixed camera' if rests else 'given'}"),
            Notice.info(NoticeCode.DEPTH_UNIT, "depth: millimetres"),
            *assumed,
        ),
    )


def _stereo_frames(
    left: NDArray[np.uint8],
    right: object,
    calibration: FilePath | Mapping[str, Any] | None,
    masks: FilePath | NDArray[np.bool_] | None,
    times_s: NDArray[np.float64],
    assumed: tuple[Notice, ...],
) -> StereoFrames:
    if not isinstance(right, np.ndarray):
        raise InputError("right", "frames in memory need the right eye's frames.", "Give right, or depth_mm.")
    _check_frames(right, "right")
    if right.shape != left.shape:
        raise _shape_error("right", right, f"{list(left.shape)} as the left eye")
    count, height, width = left.shape[:3]
    ClipLimits().check_frame("source", "the clip", width, height)
    ClipLimits().check_clip("source", "the clip", count, 2 * width, height)
    if calibration is None:
        raise InputError("calibration", "frames of both eyes need one.", "Give a file or the values of our JSON.")
    if isinstance(calibration, Mapping):
        parsed = fitted(checked_calibration(dict(calibration)), width, height)
    else:
        parsed = load_calibration(_path(calibration, "calibration"), eye_width=width, eye_height=height)

    def pairs() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
        return zip(left, right, strict=True)

    layout = Notice.info(NoticeCode.LAYOUT, "layout: frames of both eyes in memory")
    clip = StereoClip(count, height, width, pairs, _tissue(masks, left.shape[:3]), times_s, (layout, *assumed))
    return StereoFrames(clip, parsed)
