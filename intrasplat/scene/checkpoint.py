"""A finished scene on disk.

    directory/
    ├── scene.safetensors   "exact", "half": gaussians.*, deformation.* and seen; "compact": the tensors of compact.py
    ├── ...                 files that rendering does not need, such as recorded.zip
    └── manifest.json       format, camera, poses, times, settings; shape and type of each tensor, SHA-256 of each file

The manifest is written last, so a folder without one contains no scene. docs/scene-file.md describes both files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError, SceneError
from intrasplat.files.durable import FOR_ALL, replace_file
from intrasplat.names import DETAIL, MANIFEST, SCENE
from intrasplat.scene.compact import unpack
from intrasplat.scene.files import dtype_name, parse_tensors, read_file
from intrasplat.scene.scene import TrainedScene, check, check_finite
from intrasplat.scene.training_pictures import pictures_of
from intrasplat.splat.deformation import MOTIONS, Deformation, restore
from intrasplat.splat.gaussians import Gaussians

FORMAT = "intrasplat-scene"
FORMAT_VERSION = 2
"""It rises when an older reader would misread what is written."""
EXACT, COMPACT = "exact", "compact"
HALF = "half"
"""As exact, with some tensors as float16: segments of a live feed (intrasplat/live/past_segment.py)."""
SCENE_FILE, MANIFEST_FILE = SCENE, MANIFEST
MISFITS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Errors that reading raises where a manifest's entry or a tensor has the wrong shape or type."""


def save_scene(
    directory: Path, scene: TrainedScene, beside: Mapping[str, bytes] | None = None, *, halved: Collection[str] = ()
) -> None:
    """Write the scene into a directory; create the directory if it is missing, and replace a scene that is there.

    beside: the contents of further files, by name. halved: tensors of an exact scene that are stored as float16.

    Raises:
        SceneError: a number is not finite or out of its range, or the tensors do not belong together. Then nothing is
            written.
    """
    check(scene)
    tensors = {name: each.half() if name in halved else each for name, each in scene.file_tensors().items()}
    check_finite(tensors)
    directory.mkdir(parents=True, exist_ok=True)
    content = save(tensors) if halved else scene.file_content
    manifest = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "coding": HALF if halved else EXACT if scene.stored is None else COMPACT,
        "deformation": scene.deformation.kind,
        "gaussians": len(scene.gaussians),
        "intrinsics": scene.intrinsics.numbers(),
        "world_from_camera": scene.world_from_camera.tolist(),
        "frame_times_s": scene.frame_times_s.tolist(),
        "units_per_mm": scene.units_per_mm,
        "preset": scene.preset,
        "seed": scene.seed,
        "settings": scene.settings,
        "trained_t": list(scene.trained_t),
        "right_eye_mm": scene.right_eye_mm,
        "tensors": {name: {"shape": list(each.shape), "dtype": dtype_name(each)} for name, each in tensors.items()},
        "files": {SCENE_FILE: _listed(content)},
        "beside": {name: _listed(each) for name, each in (beside or {}).items()},
    }
    text = json.dumps(manifest, indent=1, allow_nan=False)
    for name, each in (beside or {}).items():
        replace_file(directory / name, each, FOR_ALL)
    replace_file(directory / SCENE_FILE, content, FOR_ALL)
    replace_file(directory / MANIFEST_FILE, text.encode(), FOR_ALL)


def _listed(content: bytes) -> dict[str, Any]:
    """The manifest's entry of a file."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def check_is_scene(directory: Path, argument: str) -> None:
    """Raise InputError, which names the caller's argument, if the directory contains no scene."""
    if not (directory / MANIFEST_FILE).is_file():
        raise InputError(argument, f"{directory} holds no scene.", "Name a folder that reconstruct wrote.")


def load_scene(directory: Path) -> TrainedScene:
    """The scene in a directory, on the CPU, after a check of every file against its hash.

    Raises:
        SceneError: the scene is missing, damaged or of another version, or a tensor or number has a wrong shape, type
            or range.
    """
    manifest = _read_manifest(directory / MANIFEST_FILE)
    _check_motion(manifest.get("deformation"), directory)
    try:
        data = {name: _read_checked(directory / _plain(name), expected) for name, expected in manifest["files"].items()}
        tensors = parse_tensors(data[SCENE_FILE], directory / SCENE_FILE)
        _check_declared(tensors, manifest["tensors"])
        scene = _scene_of(manifest, tensors)
    except MISFITS as error:
        raise SceneError(f"The scene in {directory} does not fit its manifest: {error!r}.") from error
    check(scene)
    return replace(scene, pictures=pictures_of(directory)) if (directory / DETAIL).is_file() else scene


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(read_file(path))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is damaged: {error}.") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise SceneError(f"{path} is not the manifest of a scene.")
    if manifest.get("version") != FORMAT_VERSION:
        raise SceneError(
            f"{path} has format version {manifest.get('version')}; this program reads version {FORMAT_VERSION}. "
            "Reconstruct the clip again, or use the version of intrasplat that wrote the scene."
        )
    return manifest


def _check_motion(kind: object, directory: Path) -> None:
    """Raise SceneError if no motion of this kind is registered."""
    if isinstance(kind, str) and kind not in MOTIONS:
        raise SceneError(
            f"The scene in {directory} has the motion {kind!r}; this program knows {', '.join(MOTIONS)}. A motion of "
            "the laboratory is known after register_variants() of lab.evaluate.variants, any other after "
            "register_motion() of intrasplat.splat.deformation."
        )


def _read_checked(path: Path, expected: dict[str, Any]) -> bytes:
    data = read_file(path)
    if len(data) != expected["bytes"] or hashlib.sha256(data).hexdigest() != expected["sha256"]:
        raise SceneError(f"{path} is damaged: {len(data)} bytes that do not match the hash in the manifest.")
    return data


def _check_declared(tensors: dict[str, Tensor], declared: dict[str, Any]) -> None:
    found = {name: {"shape": list(each.shape), "dtype": dtype_name(each)} for name, each in tensors.items()}
    if found != declared:
        names = sorted(name for name in found | declared if found.get(name) != declared.get(name))
        raise SceneError(f"The scene's tensors are not those its manifest lists: {', '.join(names)}.")


def _scene_of(manifest: dict[str, Any], tensors: dict[str, Tensor]) -> TrainedScene:
    gaussians, deformation, seen = _model_of(manifest, tensors)
    poses = np.array(manifest["world_from_camera"], dtype=np.float64)
    times_s = np.array(manifest["frame_times_s"], dtype=np.float64)
    right_eye_mm = None
    if (given := manifest.get("right_eye_mm")) is not None:  # scenes of version 0.3 have none
        x, y, z = (float(each) for each in given)
        right_eye_mm = x, y, z
    if times_s.ndim != 1 or poses.shape != (len(times_s), 4, 4):
        raise ValueError(f"world_from_camera has shape {poses.shape} for frame_times_s of {times_s.shape}")
    return TrainedScene(
        gaussians=gaussians,
        deformation=deformation,
        intrinsics=Intrinsics.parsed(manifest["intrinsics"]),
        world_from_camera=poses,
        frame_times_s=times_s,
        units_per_mm=float(manifest["units_per_mm"]),
        preset=str(manifest["preset"]),
        trained_t=tuple(float(t) for t in manifest["trained_t"]),
        right_eye_mm=right_eye_mm,
        seen=seen,
        seed=int(manifest["seed"]),
        settings=dict(manifest["settings"]),
        stored=tensors if _coding(manifest) == COMPACT else None,
    )


def _model_of(manifest: dict[str, Any], tensors: dict[str, Tensor]) -> tuple[Gaussians, Deformation, Tensor]:
    """Gaussians, motion and `seen`, from the exact or the compact form."""

    def under(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): each for name, each in tensors.items() if name.startswith(prefix)}

    deformation: Deformation
    if _coding(manifest) != COMPACT:
        tensors = {name: each.float() if each.dtype == torch.float16 else each for name, each in tensors.items()}
        deformation = restore(manifest["deformation"], under("deformation."))
        gaussians, seen = Gaussians(**under("gaussians.")), tensors["seen"]
    else:
        check_finite(tensors)
        gaussians, deformation, seen = unpack(tensors).model()
    if deformation.kind != manifest["deformation"] or len(gaussians) != manifest["gaussians"]:
        raise ValueError(f"{len(gaussians)} Gaussians of kind {deformation.kind} are not those the manifest speaks of")
    return gaussians, deformation, seen


def _coding(manifest: dict[str, Any]) -> str:
    coding = str(manifest["coding"])
    if coding not in (EXACT, HALF, COMPACT):
        raise ValueError(f"coding {coding!r} is none of {EXACT}, {HALF} and {COMPACT}")
    return coding


def _plain(name: str) -> str:
    if name in ("", ".", "..") or Path(name).name != name:
        raise SceneError(f"{name!r} is not the name of a file in a scene's folder.")
    return name
