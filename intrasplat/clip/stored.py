"""A clip with depth in a folder: one .npy file per array, and manifest.json, which is written last.

A folder without manifest counts as empty. This module does not depend on how the clip was computed.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.recorded_masks import Rectification
from intrasplat.clip.types import PIXELS, DepthClip, Eye
from intrasplat.files.durable import flush, replace_file
from intrasplat.machine.mapped import let_go
from intrasplat.notices import Notice
from intrasplat.report import CameraPoses, FieldOfView, Masks, RightEye

VERSION = 6
"""Format version, raised with every change of the folder's content; no version reads another's folder."""
MANIFEST = "manifest.json"
EYES = ("left", "right")
ARRAYS = (*PIXELS, "world_from_camera")
TIMES, FIELD = "frame_times_s", "field_of_view"


def save_clip(folder: Path, clip: DepthClip, identity: str, should_stop: Callable[[], bool] = lambda: False) -> None:
    """Write the clip into a folder, which is created if necessary. It is on disk when this returns.

    Args:
        identity: any text that identifies the clip's source; load_clip compares it.
        should_stop: called before each frame; if it returns True, the folder is removed.

    Raises:
        OSError: the disk is full or refuses; the folder is removed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).unlink(missing_ok=True)
    try:
        if not all(_write(folder / f"{name}.npy", array, should_stop) for name, array in _arrays(clip).items()):
            shutil.rmtree(folder, ignore_errors=True)
            return
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    flush(folder)
    manifest = {
        "version": VERSION,
        "identity": identity,
        "intrinsics": [eye.intrinsics.numbers() for eye in clip.eyes],
        "registration": clip.registration and clip.registration.model_dump(),
        "masks": clip.masks and clip.masks.model_dump(),
        "fov": clip.fov and clip.fov.model_dump(),
        "rectification": clip.rectification and clip.rectification.numbers(),
        "poses": clip.poses and clip.poses.model_dump(),
        "skipped": clip.skipped,
        "assumptions": [notice.model_dump() for notice in clip.assumptions],
        "warnings": [notice.model_dump() for notice in clip.warnings],
        "measurements": clip.measurements,
    }
    replace_file(folder / MANIFEST, json.dumps(manifest).encode())


def load_clip(folder: Path, identity: str) -> DepthClip | None:
    """The clip that save_clip wrote with this identity, with its arrays mapped into memory; None if there is none.

    Do not write to the arrays. The files may be removed at once: the mappings last as long as the arrays.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        if (manifest["version"], manifest["identity"]) != (VERSION, identity):
            return None
        eyes = [_eye(folder, name, each) for name, each in zip(EYES, manifest["intrinsics"], strict=False)]
        return DepthClip(
            **eyes[0],
            frame_times_s=np.load(folder / f"{TIMES}.npy"),
            right=Eye(**eyes[1]) if len(eyes) > 1 else None,
            registration=manifest["registration"] and RightEye.model_validate(manifest["registration"]),
            masks=manifest["masks"] and Masks.model_validate(manifest["masks"]),
            fov=manifest["fov"] and FieldOfView.model_validate(manifest["fov"]),
            rectification=manifest["rectification"] and Rectification.parsed(manifest["rectification"]),
            poses=manifest["poses"] and CameraPoses.model_validate(manifest["poses"]),
            skipped=tuple(manifest["skipped"]),
            assumptions=tuple(Notice.model_validate(each) for each in manifest["assumptions"]),
            warnings=tuple(Notice.model_validate(each) for each in manifest["warnings"]),
            measurements=manifest["measurements"],
        )
    except (OSError, EOFError, ValueError, KeyError, TypeError):  # no clip, or files of another program
        return None


def _arrays(clip: DepthClip) -> dict[str, NDArray[Any]]:
    arrays = {
        f"{side}_{name}": getattr(eye, name) for side, eye in zip(EYES, clip.eyes, strict=False) for name in ARRAYS
    }
    fields = {f"{side}_{FIELD}": eye.field_of_view for side, eye in zip(EYES, clip.eyes, strict=False)}
    return arrays | {name: each for name, each in fields.items() if each is not None} | {TIMES: clip.frame_times_s}


def _eye(folder: Path, side: str, intrinsics: dict[str, Any]) -> dict[str, Any]:
    arrays = {name: np.asarray(np.load(folder / f"{side}_{name}.npy", mmap_mode="r+")) for name in ARRAYS}
    file = folder / f"{side}_{FIELD}.npy"
    field = np.load(file) if file.exists() else None
    return {**arrays, FIELD: field, "intrinsics": Intrinsics.parsed(intrinsics)}


def _write(path: Path, array: NDArray[Any], should_stop: Callable[[], bool]) -> bool:
    """Write an array frame by frame and wait until it is on disk; False if should_stop ended it."""
    with path.open("wb") as file:
        header = npy.header_data_from_array_1_0(np.empty((0, *array.shape[1:]), array.dtype)) | {"shape": array.shape}
        npy.write_array_header_1_0(file, header)
        for frame in array:
            if should_stop():
                return False
            file.write(np.ascontiguousarray(frame).data)
            let_go(frame)
        file.flush()
        os.fsync(file.fileno())
    return True
