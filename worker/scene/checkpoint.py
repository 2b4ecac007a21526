"""A finished scene on disk, and a training state to go on from.

Symbols: N Gaussians, T frames, C = 10 channels, B bases. Gaussians are in optimiser units (mm * units_per_mm),
poses in mm.

    directory/
    ├── scene.safetensors   "exact": every tensor, gaussians.*, deformation.*, seen; "compact": those of compact.py
    └── manifest.json       format, camera, poses, times, settings; shape and type of each tensor, SHA-256 of each file
    resume.safetensors      one file: tensors, and in its header the loop's state as JSON and a SHA-256 over both

Files are written aside, made durable and renamed; the manifest last, so a folder without one holds no scene.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch
from numpy.typing import NDArray
from safetensors.torch import load, save
from torch import Tensor

from contract.wire.errors import SceneError
from contract.wire.names import RESUME
from worker.input.camera import Intrinsics
from worker.model.deformation import Deformation, restore
from worker.model.gaussians import Gaussians
from worker.scene.compact import read

FORMAT = "intrasplat-scene"
FORMAT_VERSION = 2
"""Raised when an older reader would misread what is written. Version 1 knew exact tensors only and is still read."""
READ_VERSIONS = (1, FORMAT_VERSION)
EXACT, COMPACT = "exact", "compact"
RESUME_VERSION = 2
"""Raised whenever what a stopped run leaves changes; nothing reads older states."""
SCENE_FILE = "scene.safetensors"
MANIFEST_FILE = "manifest.json"
RESUME_FILE = RESUME
MISFITS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What reading raises where a manifest's entry or a tensor is not of the shape or type that it should be."""


@dataclass(frozen=True, eq=False)
class Scene:
    """All that rendering needs.

    gaussians, deformation  the model, optimiser units
    intrinsics              of the clip's left eye
    world_from_camera       [T, 4, 4] float64, mm: the endoscope's own poses
    frame_times_s           [T] seconds from frame 0
    units_per_mm            optimiser units = mm * units_per_mm
    preset, seed, settings  how it was trained; settings is JSON
    trained_t               model times of the training frames
    seen                    [N] float32 in [0, 1]: share of training frames that saw each Gaussian x stereo confidence
    stored                  the tensors of compact.py that gave gaussians, deformation and seen, and that stand for them
                            on disk; None: their own tensors do
    """

    gaussians: Gaussians
    deformation: Deformation
    intrinsics: Intrinsics
    world_from_camera: NDArray[np.float64]
    frame_times_s: NDArray[np.float64]
    units_per_mm: float
    preset: str
    trained_t: tuple[float, ...]
    seen: Tensor
    seed: int = 0
    settings: dict[str, Any] = field(default_factory=dict)
    stored: Mapping[str, Tensor] | None = None

    @property
    def frame_count(self) -> int:
        return int(self.world_from_camera.shape[0])

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor of the model by its name in an exact file, on the CPU."""
        named = {f"gaussians.{name}": each for name, each in self.gaussians.tensors().items()}
        moving = self.deformation.parameters() | self.deformation.constants()
        named |= {f"deformation.{name}": each for name, each in moving.items()}
        named["seen"] = self.seen
        return {name: each.detach().cpu().contiguous() for name, each in named.items()}

    def file_tensors(self) -> dict[str, Tensor]:
        """Every tensor of scene.safetensors by its name."""
        return self.tensors() if self.stored is None else dict(self.stored)

    @property
    def byte_count(self) -> int:
        """Bytes of the model's tensors in memory."""
        return sum(each.numel() * each.element_size() for each in self.tensors().values())

    @cached_property  # its length is asked for before it is written
    def file_content(self) -> bytes:
        """scene.safetensors, of the tensors as they are when it is first asked for."""
        content: bytes = save(self.file_tensors())
        return content

    @property
    def file_bytes(self) -> int:
        """Bytes of scene.safetensors."""
        return len(self.file_content)


def save_scene(directory: Path, scene: Scene, *, beside: Sequence[str] = ()) -> None:
    """Writes the scene into a directory, which is made if need be; one that is there is replaced.

    Args:
        beside: names of files already in the directory (report.json, curve.csv) whose hashes the manifest shall hold.

    Raises:
        SceneError: a number is not finite or out of its range, or the tensors do not belong together; nothing is
            written.
    """
    _check_finite(scene.tensors())
    _check_counts(scene)
    _check_values(scene)
    tensors = scene.file_tensors()
    directory.mkdir(parents=True, exist_ok=True)
    files = {SCENE_FILE: scene.file_content} | {name: (directory / _plain(name)).read_bytes() for name in beside}
    manifest = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "coding": EXACT if scene.stored is None else COMPACT,
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
        "tensors": {name: {"shape": list(each.shape), "dtype": _dtype(each)} for name, each in tensors.items()},
        "files": {
            name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in files.items()
        },
    }
    text = json.dumps(manifest, indent=1, allow_nan=False)
    _write(directory / SCENE_FILE, scene.file_content)
    _write(directory / MANIFEST_FILE, text.encode())


def load_scene(directory: Path) -> Scene:
    """The scene of a directory, on the CPU, every file checked against its hash.

    Raises:
        SceneError: missing, damaged, of another version, or with tensors or numbers of another shape, type or range.
    """
    manifest = _read_manifest(directory / MANIFEST_FILE)
    try:
        data = {name: _read_checked(directory / _plain(name), expected) for name, expected in manifest["files"].items()}
        tensors = _parse(data[SCENE_FILE], directory / SCENE_FILE)
        _check_declared(tensors, manifest["tensors"])
        scene = _scene_of(manifest, tensors)
    except MISFITS as error:
        raise SceneError(f"The scene in {directory} does not fit its manifest: {error!r}.") from error
    _check_finite(scene.tensors())
    _check_counts(scene)
    _check_values(scene)
    return scene


def save_resume(directory: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Writes a training state to directory/resume.safetensors, in place of the one before; at no time is there none.

    Args:
        tensors: of any type, for example parameters, Adam's moments and a generator's state.
        state: what JSON can hold: iteration, seconds, settings.
    """
    directory.mkdir(parents=True, exist_ok=True)
    named = {name: each.detach().cpu().contiguous() for name, each in tensors.items()}
    text = json.dumps(dict(state), sort_keys=True)
    header = {"state": text, "version": str(RESUME_VERSION), "sha256": _digest(named, text)}
    _write(directory / RESUME_FILE, save(named, metadata=header))


def load_resume(directory: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the state that save_resume wrote, on the CPU.

    Raises:
        SceneError: there is none, it is damaged, or another version wrote it.
    """
    path = directory / RESUME_FILE
    data = _read(path)
    tensors = _parse(data, path)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__", {})
    if header.get("version") != str(RESUME_VERSION):
        found = header.get("version")
        raise SceneError(
            f"{path} was written by another version ({found}; this program goes on from {RESUME_VERSION})."
        )
    if header.get("sha256") != _digest(tensors, header.get("state", "")):
        raise SceneError(f"{path} is damaged: its contents do not match their hash.")
    state: dict[str, Any] = json.loads(header["state"])
    return tensors, state


def _scene_of(manifest: dict[str, Any], tensors: dict[str, Tensor]) -> Scene:
    gaussians, deformation, seen = _model_of(manifest, tensors)
    poses = np.array(manifest["world_from_camera"], dtype=np.float64)
    times_s = np.array(manifest["frame_times_s"], dtype=np.float64)
    if times_s.ndim != 1 or poses.shape != (len(times_s), 4, 4):
        raise ValueError(f"world_from_camera has shape {poses.shape} for frame_times_s of {times_s.shape}")
    return Scene(
        gaussians=gaussians,
        deformation=deformation,
        intrinsics=Intrinsics.parsed(manifest["intrinsics"]),
        world_from_camera=poses,
        frame_times_s=times_s,
        units_per_mm=float(manifest["units_per_mm"]),
        preset=str(manifest["preset"]),
        trained_t=tuple(float(t) for t in manifest["trained_t"]),
        seen=seen,
        seed=int(manifest["seed"]),
        settings=dict(manifest["settings"]),
        stored=tensors if _coding(manifest) == COMPACT else None,
    )


def _coding(manifest: dict[str, Any]) -> str:
    coding = str(manifest["coding"]) if manifest["version"] > 1 else EXACT
    if coding not in (EXACT, COMPACT):
        raise ValueError(f"coding {coding!r} is neither {EXACT} nor {COMPACT}")
    return coding


def _model_of(manifest: dict[str, Any], tensors: dict[str, Tensor]) -> tuple[Gaussians, Deformation, Tensor]:
    """Gaussians, motion and seen of either coding."""

    def under(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): each for name, each in tensors.items() if name.startswith(prefix)}

    deformation: Deformation
    if _coding(manifest) == EXACT:
        deformation = restore(manifest["deformation"], under("deformation."))
        gaussians, seen = Gaussians(**under("gaussians.")), tensors["seen"]
    else:
        _check_finite(tensors)
        gaussians, deformation, seen = read(tensors).model()
    if deformation.kind != manifest["deformation"] or len(gaussians) != manifest["gaussians"]:
        raise ValueError(f"{len(gaussians)} Gaussians of kind {deformation.kind} are not those the manifest speaks of")
    return gaussians, deformation, seen


def _check_counts(scene: Scene) -> None:
    """N is the same everywhere, and the deformation is one of these Gaussians."""
    mean, harmonics = scene.gaussians.mean, scene.gaussians.sh
    count = mean.shape[0] if mean.ndim else 0
    degree = scene.gaussians.sh_degree if harmonics.ndim == 3 else 0
    shapes = {
        "quaternion": ((count, 4), scene.gaussians.quaternion),
        "mean": ((count, 3), mean),
        "log_scale": ((count, 3), scene.gaussians.log_scale),
        "opacity_logit": ((count,), scene.gaussians.opacity_logit),
        "seen": ((count,), scene.seen),
        "sh": ((count, (degree + 1) ** 2, 3), harmonics),
    }
    for name, (expected, tensor) in shapes.items():
        if tuple(tensor.shape) != expected or tensor.dtype != torch.float32:
            found = f"{_dtype(tensor)} {list(tensor.shape)}"
            raise SceneError(f"The scene's {name} is {found}, {count} Gaussians need float32 {list(expected)}.")
    moving = scene.deformation.parameters() | scene.deformation.constants()
    for name, tensor in moving.items():
        if tensor.dtype != torch.float32:
            raise SceneError(f"The scene's deformation has a {name} of {_dtype(tensor)}, it must be float32.")
    if "weight" in moving and moving["weight"].shape[0] != count:
        raise SceneError(f"The scene's deformation moves {moving['weight'].shape[0]} Gaussians, there are {count}.")


def _check_values(scene: Scene) -> None:
    """What is no tensor is finite, and what has a range stays in it."""
    if not 0 < scene.units_per_mm < math.inf:
        raise SceneError(f"The scene's units_per_mm is {scene.units_per_mm}, it must be above 0 and finite.")
    for name, numbers in (("world_from_camera", scene.world_from_camera), ("frame_times_s", scene.frame_times_s)):
        if not np.isfinite(numbers).all():
            raise SceneError(f"The scene's {name} holds numbers that are NaN or infinite.")
    shown = [math.isfinite(t) and 0 <= round(t * scene.frame_count) < scene.frame_count for t in scene.trained_t]
    if not shown or not all(shown):
        raise SceneError(f"The scene's trained_t are not times of its {scene.frame_count} frames.")
    if not bool(((scene.seen >= 0) & (scene.seen <= 1)).all()):
        raise SceneError(
            f"The scene's seen lies in {float(scene.seen.min()):g} to {float(scene.seen.max()):g}, not in 0 to 1."
        )


def _check_declared(tensors: dict[str, Tensor], declared: dict[str, Any]) -> None:
    found = {name: {"shape": list(each.shape), "dtype": _dtype(each)} for name, each in tensors.items()}
    if found != declared:
        names = sorted(name for name in found | declared if found.get(name) != declared.get(name))
        raise SceneError(f"The scene's tensors are not those its manifest lists: {', '.join(names)}.")


def _check_finite(tensors: dict[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            broken = int((~torch.isfinite(tensor)).sum())
            raise SceneError(f"The scene's {name} holds {broken} values that are NaN or infinite.")


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(_read(path))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is damaged: {error}.") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise SceneError(f"{path} is not the manifest of a scene.")
    if manifest.get("version") not in READ_VERSIONS:
        raise SceneError(
            f"{path} is of version {manifest.get('version')}, this program reads versions "
            f"{' and '.join(map(str, READ_VERSIONS))}."
        )
    return manifest


def _read_checked(path: Path, expected: dict[str, Any]) -> bytes:
    data = _read(path)
    if len(data) != expected["bytes"] or hashlib.sha256(data).hexdigest() != expected["sha256"]:
        raise SceneError(f"{path} is damaged: {len(data)} bytes that do not match the hash in the manifest.")
    return data


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}.") from error


def _parse(data: bytes, path: Path) -> dict[str, Tensor]:
    try:
        return dict(load(data))
    except (safetensors.SafetensorError, ValueError, KeyError) as error:
        raise SceneError(f"{path} is damaged: {error}.") from error


def _digest(tensors: Mapping[str, Tensor], state: str) -> str:
    """SHA-256 over the state and every tensor's name, type, shape and bytes, by name."""
    digest = hashlib.sha256(state.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {_dtype(tensor)} {list(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _dtype(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")


def _plain(name: str) -> str:
    if name in ("", ".", "..") or Path(name).name != name:
        raise SceneError(f"{name!r} is not the name of a file in a scene's folder.")
    return name


def _write(path: Path, data: bytes) -> None:
    """The whole file or none of it, also when the power fails."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
