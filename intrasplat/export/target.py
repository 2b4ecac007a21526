"""What is exported: a scene with the caller's options, and its Gaussians at one moment in mm.

Symbols: T frames, N Gaussians, K coefficients a colour channel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.errors import LimitError
from intrasplat.formats import ExportOptions
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import Device
from intrasplat.splat.constants import SH_C0

MAX_EXPORT_BYTES = 4 << 30


@dataclass(frozen=True)
class ExportTarget:
    """A scene, the options of its export, and the device that renders it."""

    scene: TrainedScene
    options: ExportOptions
    device: Device

    @property
    def t(self) -> float:
        """The model time, clamped to the clip, for formats of one moment."""
        return min(self.options.t or 0.0, (self.scene.frame_count - 1) / self.scene.frame_count)

    @cached_property
    def frames(self) -> range:
        """The frames to write, for formats over time."""
        return range(0, self.scene.frame_count, self.options.every or 1)

    def time_of(self, frame: int) -> float:
        """Model time of a frame."""
        return frame / self.scene.frame_count

    def check_size(self, bytes_per_frame: int) -> None:
        """Raise LimitError if all frames would take more than MAX_EXPORT_BYTES."""
        if (size := bytes_per_frame * len(self.frames)) > MAX_EXPORT_BYTES:
            problem = (
                f"{len(self.frames)} frames take {size / 2**30:.1f} GiB; at most {MAX_EXPORT_BYTES >> 30} are made."
            )
            enough = (self.options.every or 1) * -(-size // MAX_EXPORT_BYTES)
            raise LimitError("every", problem, f"Use every={enough}.")


@dataclass(frozen=True)
class Splats:
    """The Gaussians at one moment, in mm and the world's axes (OpenCV's).

    mean_mm        [N, 3] float32
    log_scale_mm   [N, 3] float32 natural logarithms of the standard deviations
    quaternion     [N, 4] float32 wxyz, length 1
    opacity_logit  [N] float32
    sh             [N, K, 3] float32
    """

    mean_mm: NDArray[np.float32]
    log_scale_mm: NDArray[np.float32]
    quaternion: NDArray[np.float32]
    opacity_logit: NDArray[np.float32]
    sh: NDArray[np.float32]

    @property
    def scale_mm(self) -> NDArray[np.float32]:
        """[N, 3] standard deviations."""
        return np.exp(self.log_scale_mm)

    @property
    def opacity(self) -> NDArray[np.float32]:
        """[N] in (0, 1)."""
        return np.asarray(1 / (1 + np.exp(-self.opacity_logit)), np.float32)

    @property
    def colour(self) -> NDArray[np.float32]:
        """[N, 3] in [0, 1]: the part of the colour that is the same from every direction."""
        return np.asarray(np.clip(0.5 + SH_C0 * self.sh[:, 0], 0, 1), np.float32)


def splats_at(scene: TrainedScene, t: float) -> Splats:
    """The scene's Gaussians deformed to model time t.

    Raises:
        ValueError: t is not a finite number.
    """
    if not math.isfinite(t):
        raise ValueError(f"t must be a finite number, not {t}")
    with torch.no_grad():
        moved = scene.deformation.deform(scene.gaussians, t)
        return Splats(
            (moved.mean / scene.units_per_mm).to(torch.float32).numpy(),
            (moved.log_scale - math.log(scene.units_per_mm)).to(torch.float32).numpy(),
            torch.nn.functional.normalize(moved.quaternion, dim=-1).to(torch.float32).numpy(),
            moved.opacity_logit.to(torch.float32).numpy(),
            moved.sh.to(torch.float32).numpy(),
        )


def as_bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Numbers in [0, 1] as 0 to 255."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
