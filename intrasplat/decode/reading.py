"""The work of the decoding process: opens the clip, reads its calibration, writes every frame to its folder.

A stereo clip is reported before its frames are read, so that the parent can process frames as they arrive.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av  # noqa: F401 (loaded before the process is confined)
import cv2
from numpy.typing import NDArray

from intrasplat.clip import ClipLimits, DepthClip, StereoClip, find_calibration, open_clip
from intrasplat.clip.calibration import load_calibration
from intrasplat.clip.given_field import read_field, with_field
from intrasplat.clip.layouts import register_layout
from intrasplat.decode.handover import FIELDS, MASKS, write_arrays
from intrasplat.decode.reports import Reports
from intrasplat.errors import InputError
from intrasplat.options import ClipOptions

_OPENING_SHARE = 0.5  # of the stage; a video is read once to count its frames, and once to write them


def read_clip(request: dict[str, Any], folder: Path, reports: Reports) -> dict[str, Any]:
    """Write the clip's arrays into `folder`. Returns the other data of a clip with depth, for JSON; those of a stereo
    clip are reported when it is opened, after its masks and times are written.

    Raises:
        MemoryError: there is too little memory, also if OpenCV reports it.
        InputError: the clip or its calibration cannot be used.
    """
    try:
        return _read_clip(request, folder, reports)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from error
        raise


def _read_clip(request: dict[str, Any], folder: Path, reports: Reports) -> dict[str, Any]:
    max_frames = request["limits"]["frames"]
    opened = 0

    def picture() -> None:
        nonlocal opened
        opened += 1  # the total is unknown: the share approaches its end without reaching it
        reports.share = max(reports.share, _OPENING_SHARE * opened / (opened + max_frames))
        reports.picture()

    limits = ClipLimits(**request["limits"], on_picture=picture)
    for file in request["layouts"]:
        register_layout(Path(file))
    paths = dict(request["paths"])
    given_calibration, fov_mask = paths.pop("calibration", None), paths.pop("fov_mask", None)
    options = ClipOptions.model_construct(**request["options"])  # checked by the parent; may name a user's layout
    clip = open_clip(**paths, options=options, limits=limits)
    if fov_mask is not None:
        reports.reading("fov_mask")
        clip = with_field(clip, read_field(Path(fov_mask), limits))
        reports.reading("clip")
    fields = _given_fields(clip)
    write_arrays(folder, zip(FIELDS, fields, strict=False))
    height, width = clip.rgb.shape[1:3] if isinstance(clip, DepthClip) else (clip.height, clip.width)
    description = {
        "size": [clip.frame_count, height, width],
        "assumptions": [each.model_dump() for each in clip.assumptions],
        "warnings": [each.model_dump() for each in clip.warnings],
        "fields": len(fields),
        "damaged": [] if isinstance(clip, DepthClip) else list(clip.damaged),
    }
    if isinstance(clip, DepthClip):
        write_arrays(folder, _depth_arrays(clip, reports))
        masks = clip.masks and clip.masks.model_dump()
        first_pose = None if clip.first_pose is None else clip.first_pose.tolist()
        return description | {"intrinsics": clip.intrinsics.numbers(), "masks": masks, "first_pose": first_pose}
    reports.reading("calibration")
    path = given_calibration or find_calibration(paths["path"], folder, limits)
    calibration = _calibration(path, clip)
    reports.reading("clip")
    masked = [name for name in MASKS if getattr(clip, name) is not None]
    write_arrays(folder, [("frame_times_s", clip.frame_times_s), *((name, getattr(clip, name)) for name in masked)])
    reports.opened(description | {"masked": masked, "calibration": calibration})
    write_arrays(folder, _stereo_frames(clip, reports))
    return {}


def _given_fields(clip: StereoClip | DepthClip) -> tuple[NDArray[Any], ...]:
    """The fields of view [H, W] that the caller gave."""
    if isinstance(clip, StereoClip):
        return clip.given_fields
    return () if clip.field_of_view is None else (clip.field_of_view,)


def _depth_arrays(clip: DepthClip, reports: Reports) -> Iterator[tuple[str, NDArray[Any]]]:
    names = ("rgb", "tissue", "depth_mm", "depth_confidence", "world_from_camera", "frame_times_s")
    done = 0
    for name in names:
        for frame in getattr(clip, name):
            done += 1
            share = done / (len(names) * clip.frame_count)
            reports.share = max(reports.share, _OPENING_SHARE + (1 - _OPENING_SHARE) * share)
            reports.picture()  # so that a slow disk does not look like a hanging decoder
            yield name, frame


def _stereo_frames(clip: StereoClip, reports: Reports) -> Iterator[tuple[str, NDArray[Any]]]:
    found = 0
    for found, (left, right) in enumerate(clip.pairs(), start=1):
        if found > clip.frame_count:
            break
        yield "left", left
        yield "right", right
        reports.frames = found  # write_arrays requests the next one after writing these
        reports.picture()
    if found < clip.frame_count:
        raise InputError("clip", f"it ended after {found} of {clip.frame_count} frames.", "Give the whole recording.")


def _calibration(path: Path | str | None, clip: StereoClip) -> dict[str, Any]:
    if path is None:
        problem = f"a stereo clip of {clip.width} x {clip.height} px an eye needs one, and none was given."
        remedy = "Give a calibration: our JSON (docs/conventions.md), OpenCV YAML or XML, or StereoMIS ini."
        raise InputError("calibration", problem, remedy)
    calibration = load_calibration(path, eye_width=clip.width, eye_height=clip.height, pixel_aspect=clip.pixel_aspect)
    return calibration.model_dump(mode="json")
