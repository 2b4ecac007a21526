"""A trained model, and everything that rendering it needs.

Symbols: N Gaussians, T frames. Gaussians are in optimiser units (mm * units_per_mm), poses in mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from intrasplat.camera import Intrinsics
from intrasplat.errors import SceneError
from intrasplat.motion.veil import Veil
from intrasplat.motion.vignetting import Vignetting
from intrasplat.notices import Notice, NoticeCode
from intrasplat.scene.files import dtype_name
from intrasplat.scene.training_pictures import TrainingPictures
from intrasplat.splat.deformation import Deformation
from intrasplat.splat.gaussians import Gaussians

POSE_WARNINGS = frozenset(
    {
        NoticeCode.POSES_UNSURE,
        NoticeCode.CAMERA_OR_TISSUE,
        NoticeCode.POSE_JITTER,
        NoticeCode.POSES_CONTRADICT,
    }
)
"""Warnings of a clip that every view of its scene repeats: a view is only as right as the poses of its training."""


MAX_LOG_GAIN = 5.0
"""Seven octaves of recorded values, more than a camera's range."""
MAX_POWER = 100.0
"""Of a vignetting; recordings have up to 6."""


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """A trained model, and everything that rendering it needs.

    gaussians, deformation  the model, optimiser units
    intrinsics              camera of the clip's left eye
    world_from_camera       [T, 4, 4] float64, mm: the endoscope's own poses
    frame_times_s           [T] seconds from frame 0
    units_per_mm            optimiser units = mm * units_per_mm
    preset, seed, settings  how it was trained; settings is JSON
    trained_t               model times of the training frames
    seen                    [N] float32 in [0, 1]: how likely each Gaussian is right (intrasplat/quality/trust.py); 0:
                            no training frame saw it
    right_eye_mm            position of the right eye in the left one's camera axes, if both trained the model; the eyes
                            decide how much of the Gaussians' gloss a view shows; None: the model has no gloss
    stored                  compact tensors, which are written to disk instead of the model's own, and from which
                            gaussians, deformation and seen were unpacked; None: the scene is exact
    pictures                recorded pictures of the training frames; None: they are not kept
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
    right_eye_mm: tuple[float, float, float] | None = None
    seed: int = 0
    settings: dict[str, Any] = field(default_factory=dict)
    stored: Mapping[str, Tensor] | None = None
    pictures: TrainingPictures | None = None

    @property
    def frame_count(self) -> int:
        """T."""
        return int(self.world_from_camera.shape[0])

    @cached_property
    def trained_frames(self) -> list[int]:
        """The training frames."""
        return [round(t * self.frame_count) for t in self.trained_t]

    @cached_property
    def pose_warnings(self) -> tuple[Notice, ...]:
        """The clip's warnings in POSE_WARNINGS: why the endoscope's poses may be wrong."""
        return tuple(Notice.model_validate(each) for each in self.settings.get("pose_warnings", ()))

    @cached_property
    def motion_error(self) -> float:
        """Error of the motion between training frames, in squared grey levels of 255; 0 where motion was followed.

        Raises:
            ValueError: the stored number is negative or not finite.
        """
        error = float(self.settings.get("motion_error", 0))
        if not 0 <= error < math.inf:
            raise ValueError(f"motion_error is {error}")
        return error

    @cached_property
    def log_gains(self) -> NDArray[np.float64] | None:
        """[T, 3] logarithms of the recorded frames' gains of R G B against the model's light; None: they are equal.

        Raises:
            ValueError: the stored numbers are not those.
        """
        stored = self.settings.get("log_gains")
        if stored is None:
            return None
        found = np.array(stored, np.float64)
        if found.shape != (self.frame_count, 3) or not (np.abs(found) <= MAX_LOG_GAIN).all():
            raise ValueError(f"log_gains are not {self.frame_count} x 3 numbers up to {MAX_LOG_GAIN:g}")
        return found

    @cached_property
    def vignetting(self) -> Vignetting | None:
        """How the recorded frames darken towards their border against the model's light; None: not modelled.

        Raises:
            ValueError: the stored numbers are none, or too large.
        """
        stored = self.settings.get("vignetting")
        if stored is None:
            return None
        power, level = map(float, stored)
        if not (0 <= power <= MAX_POWER and 1e-3 <= level <= 1):
            raise ValueError(f"vignetting is {power}, {level}")
        return Vignetting(power, level)

    def gains(self, t: float) -> NDArray[np.float32] | None:
        """[3] gains of R G B of the light in which model time t was recorded, against the model's; None: all are 1."""
        if self.log_gains is None:
            return None
        frame = t * self.frame_count
        logs = [np.interp(frame, np.arange(self.frame_count), each) for each in self.log_gains.T]
        return np.exp(logs).astype(np.float32)

    @cached_property
    def veil(self) -> Veil | None:
        """The smoke before the left eye, which the model does not have; None: none was found.

        Raises:
            ValueError: the stored values are not those of a veil.
        """
        stored = self.settings.get("veil")
        return None if stored is None else Veil.read(stored, self.frame_count)

    def without_motion(self) -> TrainedScene:
        """The scene without the weights of its motion, for a caller that has them elsewhere."""
        return replace(self, deformation=self.deformation.select(torch.zeros(0, dtype=torch.int64)))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the model by their names in an exact file, on the CPU."""
        named = {f"gaussians.{name}": each for name, each in self.gaussians.tensors().items()}
        moving = self.deformation.parameters() | self.deformation.constants()
        named |= {f"deformation.{name}": each for name, each in moving.items()}
        if self.right_eye_mm is None:
            del named["gaussians.gloss"]
        named["seen"] = self.seen
        return {name: each.detach().cpu().contiguous() for name, each in named.items()}

    def file_tensors(self) -> dict[str, Tensor]:
        """All tensors of scene.safetensors by name."""
        return self.tensors() if self.stored is None else dict(self.stored)

    @property
    def byte_count(self) -> int:
        """Bytes of the model's tensors in memory."""
        return sum(each.numel() * each.element_size() for each in self.tensors().values())

    @cached_property  # the report needs its length before it is written
    def file_content(self) -> bytes:
        """The bytes of scene.safetensors, encoded at the first call."""
        content: bytes = save(self.file_tensors())
        return content

    @property
    def file_bytes(self) -> int:
        """Length of scene.safetensors in bytes."""
        return len(self.file_content)


def check(scene: TrainedScene) -> None:
    """Check that the parts of a scene belong together and its numbers are in their ranges.

    Raises:
        SceneError: two parts do not belong together, or a number is out of its range; the message names the part.
    """
    check_finite(scene.tensors())
    _check_counts(scene)
    _check_values(scene)


def check_finite(tensors: dict[str, Tensor]) -> None:
    """Raise SceneError where a tensor contains NaN or infinity."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not is_finite(tensor):
            broken = int((~torch.isfinite(tensor)).sum())
            raise SceneError(f"The scene's {name} holds {broken} values that are NaN or infinite.")


def is_finite(tensor: Tensor) -> bool:
    """Whether no number is NaN or infinite. It allocates no mask of the tensor's size, as torch.isfinite would."""
    if tensor.dim() > 1 and not tensor.is_contiguous():  # aminmax would copy it
        return all(is_finite(row) for row in tensor)
    return tensor.numel() == 0 or all(math.isfinite(float(each)) for each in tensor.aminmax())


def _check_counts(scene: TrainedScene) -> None:
    """Raise SceneError unless every tensor is float32 and has one row per Gaussian."""
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
        "gloss": ((count,), scene.gaussians.gloss),
    }
    for name, (expected, tensor) in shapes.items():
        if tuple(tensor.shape) != expected or tensor.dtype != torch.float32:
            found = f"{dtype_name(tensor)} {list(tensor.shape)}"
            raise SceneError(f"The scene's {name} is {found}, {count} Gaussians need float32 {list(expected)}.")
    moving = scene.deformation.parameters() | scene.deformation.constants()
    for name, tensor in moving.items():
        if tensor.dtype != torch.float32:
            raise SceneError(f"The scene's deformation has a {name} of {dtype_name(tensor)}, it must be float32.")
    if "weight" in moving and moving["weight"].shape[0] != count:
        raise SceneError(f"The scene's deformation moves {moving['weight'].shape[0]} Gaussians, there are {count}.")


def _check_values(scene: TrainedScene) -> None:
    """Raise SceneError unless all numbers other than the tensors are finite and in their ranges."""
    if not 0 < scene.units_per_mm < math.inf:
        raise SceneError(f"The scene's units_per_mm is {scene.units_per_mm}, it must be above 0 and finite.")
    offset_mm = scene.right_eye_mm
    if offset_mm is not None and not (len(offset_mm) == 3 and 0 < math.hypot(*offset_mm) < math.inf):
        raise SceneError(f"The scene's right_eye_mm is {offset_mm}, not three finite numbers that are not all 0.")
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
