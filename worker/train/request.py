"""What to reconstruct, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from contract.wire.errors import InputError
from contract.wire.names import MaskPolarity, PoseConvention
from worker.input.clip import ClipLimits, DepthClip
from worker.train.presets import Preset


@dataclass(frozen=True)
class ReconstructionRequest:
    """What to reconstruct and how; the fields are those of `intrasplat reconstruct --help`.

    preset is a name, or a preset of the caller's own. budget_s and iterations exclude each other; without either the
    preset decides. accepted_at_s is the Unix time at which the clip was accepted, for t_post_s; None means now.
    limits are what this machine accepts; None means what its memory allows. clip is a path, or a clip with depth that
    is in memory already and is neither decoded nor matched.
    """

    clip: Path | DepthClip
    right: Path | None = None
    layout: str = "auto"
    calibration: Path | None = None
    masks: Path | None = None
    mask_polarity: MaskPolarity = "auto"
    pose_convention: PoseConvention = "opengl"
    holdout: str = "every8"
    preset: str | Preset = "fast"
    budget_s: float | None = None
    iterations: int | None = None
    device: str = "auto"
    seed: int = 0
    accepted_at_s: float | None = None
    limits: ClipLimits | None = None


def check_options(request: ReconstructionRequest) -> None:
    """Refuse a length or seed that cannot be meant; InputError names it."""
    budget_s, iterations = request.budget_s, request.iterations
    if budget_s is not None and iterations is not None:
        problem = f"{budget_s:g} s came together with {iterations} iterations."
        raise InputError("options.budget_s", problem, "Give one of them.")
    if budget_s is not None and not (math.isfinite(budget_s) and budget_s > 0):
        raise InputError("options.budget_s", f"{budget_s:g} s is no time to train in.", "Give seconds above 0.")
    if iterations is not None and iterations < 1:
        raise InputError("options.iterations", f"{iterations} is less than one step.", "Give 1 or more.")
    check_seed(request.seed)


def check_seed(seed: int) -> None:
    """Refuse a seed that no generator takes; InputError names it."""
    if seed < 0:
        raise InputError("options.seed", f"{seed} is negative.", "Give 0 or more.")
