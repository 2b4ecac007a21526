"""How coarse a scene may be stored: the coarsest step whose measured loss on training frames stays within a tolerance.

Symbols: N Gaussians. Held-out frames are not looked at.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.checkpoint import Scene
from worker.clip import DepthClip
from worker.compact import STATE, prepare, round_to
from worker.deformation import SharedBasis
from worker.gaussians import SH_C0
from worker.metrics import psnr_tissue
from worker.render import model_of
from worker.targets import TrainingFrames
from worker.visibility import spread

TOLERANCE_DB = 0.1
"""psnr_tissue that a stored scene may lose on its training frames; held-out frames lost less (docs/decisions/012)."""
EFFECT_FRAMES = 12
"""Training frames in which the effect of each number is measured."""
JUDGED_FRAMES = 8
TRIALS = 6
NEARLY = 0.85
"""A trial that uses so much of the tolerance is the last."""
LEAST_STEP = 1e-5
FIRST_STEP = 4e-4
"""Of white; what scenes of 38 dB took."""
SMALLER = 0.97
"""What the step that should just do is taken times, so that the next trial most likely does."""


@dataclass(frozen=True, eq=False)
class Shrunk:
    """A scene as it will be read back, and what that cost.

    scene    the model after rounding, its numbers in scene.stored
    step     change of the picture, 1 from black to white, that one step of a number makes in the mean
    loss_db  psnr_tissue lost on so many training `frames`
    was_bytes  of the model's floats
    """

    scene: Scene
    step: float
    loss_db: float
    frames: int
    was_bytes: int

    @property
    def words(self) -> tuple[str, ...]:
        """What was chosen, for the report."""
        return (
            f"Numbers are stored in steps that change the picture by {255 * self.step:.2g} of 255: "
            f"{self.scene.file_bytes / 1e6:.2f} MB instead of {self.was_bytes / 1e6:.1f}, for {self.loss_db:.2f} dB on "
            f"{self.frames} training frames. All scores are of the stored scene.",
        )

    @property
    def measurements(self) -> dict[str, float]:
        """The same as numbers."""
        return {"stored_step": self.step, "stored_loss_db": self.loss_db}


def shrink(scene: Scene, clip: DepthClip, frames: TrainingFrames, tolerance_db: float = TOLERANCE_DB) -> Shrunk | None:
    """The scene in whole numbers; None for a model that is stored as floats, or where no trial kept the tolerance.

    The loss grows about as the step's square, so each trial says which step should just keep the tolerance.
    """
    if not isinstance(scene.deformation, SharedBasis) or scene.gaussians.sh_degree > 0:
        return None
    times = [float(frames.t[index]) for index in frames.indices]
    effect = _effect(scene, clip, frames, FIRST_STEP)
    prepared = prepare(scene.gaussians, scene.deformation, scene.seen, effect, times)
    judged = spread(frames.indices, JUDGED_FRAMES)
    exact_db = _mean_db(scene, clip, frames, judged)
    step, good, bad, best = FIRST_STEP, LEAST_STEP, math.inf, None
    for _ in range(TRIALS):
        compact = round_to(prepared, step)
        gaussians, deformation, seen = compact.model()
        rounded = dataclasses.replace(scene, gaussians=gaussians, deformation=deformation, seen=seen)
        loss_db = exact_db - _mean_db(rounded, clip, frames, judged)
        if loss_db > tolerance_db:
            bad = min(bad, step)
        elif step > good:
            good, best = step, (compact, rounded, loss_db)
            if loss_db >= NEARLY * tolerance_db:
                break
        wished = SMALLER * step * math.sqrt(_noise(tolerance_db) / max(_noise(loss_db), 1e-2 * _noise(tolerance_db)))
        step = wished if good < wished < bad else math.sqrt(good * min(bad, 100 * good))
    if best is None:
        return None
    compact, rounded, loss_db = best
    stored = dataclasses.replace(rounded, stored=compact.tensors())
    return Shrunk(stored, good, loss_db, len(judged), scene.byte_count)


def _noise(loss_db: float) -> float:
    """Squared error added, as a share of the one there was, where so many dB are lost."""
    return float(10 ** (loss_db / 10) - 1)


def _mean_db(scene: Scene, clip: DepthClip, frames: TrainingFrames, judged: Sequence[int]) -> float:
    model = model_of(scene)
    scores = []
    for index in judged:
        image = model.render(frames.cameras[index], float(frames.t[index]))
        scores.append(psnr_tissue(image[:3].transpose(1, 2, 0), clip.rgb[index], clip.tissue[index]))
    return float(np.nanmean(scores))


def _effect(scene: Scene, clip: DepthClip, frames: TrainingFrames, step: float) -> NDArray[np.float64]:
    """[STATE, N]: an error e in a number adds effect * e**2 / N to the mean squared error of the tissue's pixels.

    The square of a pixel's derivative, summed over the pixels, is the mean square of the gradient of their sum with
    random signs: one gradient a frame gives all of them (Hutchinson 1990).

    A depth also decides which of two Gaussians hides the other, and that has no derivative. So its effect is measured
    once for all, with noise of the size that rounding makes.
    """
    model, random = model_of(scene), np.random.default_rng(0)
    sampled = spread(frames.indices, EFFECT_FRAMES)
    effect = np.zeros((STATE, model.count))
    for index in sampled:
        tissue = clip.tissue[index]
        signs = np.zeros((5, *tissue.shape), np.float32)
        signs[:3] = random.choice(np.array([-1, 1], np.float32), (3, *tissue.shape)) * tissue
        model.project(frames.cameras[index], float(frames.t[index]), 0)
        gradients = model.rasterizer.cotangent_backward(signs)
        found = np.concatenate(
            [
                gradients.state[:10, : model.count],
                gradients.colour[:, : model.count] * np.float32(SH_C0),
                gradients.opacity_logit[None, : model.count],
            ]
        )
        effect += found.astype(np.float64) ** 2 * (model.count / max(3 * int(tissue.sum()), 1) / len(sampled))
    effect[2] = effect[:2].mean(0) * _depth_over_place(scene, clip, frames, effect, step)
    return effect


def _depth_over_place(
    scene: Scene, clip: DepthClip, frames: TrainingFrames, effect: NDArray[np.float64], step: float
) -> float:
    """How much more an error along the first camera's axis changes the picture than one across it, squared."""
    across = max(float(effect[:2].mean()), 1e-12)
    numbers = scene.deformation.parameters()["weight"].shape[2]  # of a channel; each adds its own error at any time
    size = step * math.sqrt(numbers / (12 * across))
    noise = size * np.random.default_rng(0).standard_normal(len(scene.gaussians)).astype(np.float32)
    exact, moved = model_of(scene), model_of(scene)
    moved.canonical[2, : moved.count] += noise
    index = frames.indices[len(frames.indices) // 2]
    first, second = (each.render(frames.cameras[index], float(frames.t[index])) for each in (exact, moved))
    error = (first[:3] - second[:3])[:, clip.tissue[index]]
    measured = float(np.mean(error.astype(np.float64) ** 2)) if error.size else 0.0
    return max(measured / size**2 / across, 1.0)
