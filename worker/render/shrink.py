"""How coarse a scene may be stored: the coarsest step whose measured loss on training frames stays within a tolerance.

Symbols: N Gaussians. Held-out frames are not looked at.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from worker.input.clip import DepthClip, spread
from worker.model.deformation import SharedBasis
from worker.raster.backend import CPU, Device
from worker.raster.model import Model
from worker.render.view import model_of
from worker.scene.compact import STATE, Compact
from worker.scene.quantize import prepare, round_to
from worker.scene.scene import Scene
from worker.train.targets import TrainingFrames

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
GROWTH = 1.7
"""The loss grows about as this power of the step (1.2 to 2.2 were seen): as its square where steps are fine, less where
most numbers are 0 already."""
SMALLER = 0.95
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


def shrink(
    scene: Scene,
    clip: DepthClip,
    frames: TrainingFrames,
    tolerance_db: float = TOLERANCE_DB,
    device: Device = CPU,
) -> Shrunk | None:
    """The scene in whole numbers; None for a model that is stored as floats, or where no trial kept the tolerance.

    Each trial says which step should just keep the tolerance.
    """
    with_tissue = [index for index in frames.indices if clip.tissue[index].any()]
    if not isinstance(scene.deformation, SharedBasis) or scene.gaussians.sh_degree > 0 or not with_tissue:
        return None
    model, judged = model_of(scene, device), spread(with_tissue, JUDGED_FRAMES)
    exact_db = _mean_db((model.render(frames.cameras[i], float(frames.t[i])) for i in judged), frames, judged)
    if not math.isfinite(exact_db):
        return None
    effect = _effect(model, clip, frames, with_tissue, len(scene.deformation.centre))
    times = [float(frames.t[index]) for index in frames.indices]
    prepared = prepare(scene.gaussians, scene.deformation, scene.seen, effect, times)
    step, good, bad, best = FIRST_STEP, LEAST_STEP, math.inf, None
    for _ in range(TRIALS):
        try:
            compact = round_to(prepared, step)
            loss_db = exact_db - _mean_db(_renders(compact, scene, frames, judged, device), frames, judged)
        except ValueError:  # finer than whole numbers of this size can be
            loss_db = math.inf
        if not loss_db <= tolerance_db:
            bad = min(bad, step)
        elif step > good:
            good, best = step, (compact, loss_db)
            if loss_db >= NEARLY * tolerance_db:
                break
        allowed = _noise(tolerance_db)
        wished = SMALLER * step * (allowed / max(_noise(loss_db), 1e-2 * allowed)) ** (1 / GROWTH)
        step = wished if good < wished < bad else math.sqrt(good * min(bad, 100 * good))
    return None if best is None else _stored(scene, *best, good, len(judged))


def _stored(scene: Scene, compact: Compact, loss_db: float, step: float, frames: int) -> Shrunk:
    gaussians, deformation, seen = compact.model()
    stored = compact.tensors()
    small = dataclasses.replace(scene, gaussians=gaussians, deformation=deformation, seen=seen, stored=stored)
    return Shrunk(small, step, loss_db, frames, scene.byte_count)


def _noise(loss_db: float) -> float:
    """Squared error added, as a share of the one there was, where so many dB are lost."""
    return float(10 ** (loss_db / 10) - 1)


def _mean_db(images: Iterable[NDArray[np.float32]], frames: TrainingFrames, judged: Sequence[int]) -> float:
    return float(np.mean([frames.psnr_tissue_db(i, image) for i, image in zip(judged, images, strict=True)]))


def _renders(
    compact: Compact, scene: Scene, frames: TrainingFrames, judged: Sequence[int], device: Device
) -> Iterator[NDArray[np.float32]]:
    """The judged frames as what is stored shows them. Only the Gaussians at their times are made, not all weights."""
    rest = SharedBasis.initial(len(scene.gaussians), bases=1)
    for index, gaussians in zip(judged, compact.at([float(frames.t[index]) for index in judged]), strict=True):
        still = model_of(dataclasses.replace(scene, gaussians=gaussians, deformation=rest), device)
        yield still.render(frames.cameras[index], 0.0)


def _effect(
    model: Model, clip: DepthClip, frames: TrainingFrames, indices: Sequence[int], bases: int
) -> NDArray[np.float64]:
    """[STATE, N]: an error e in a number adds effect * e**2 / N to the mean squared error of the tissue's pixels.

    The square of a pixel's derivative, summed over the pixels, is the mean square of the gradient of their sum with
    random signs: one gradient a frame gives all of them (Hutchinson 1990).

    A depth also decides which of two Gaussians hides the other, and that has no derivative. So its effect is measured
    once for all, with noise of the size that rounding makes.
    """
    random, sampled = np.random.default_rng(0), spread(indices, EFFECT_FRAMES)
    effect = np.zeros((STATE, model.count))
    for index in sampled:
        tissue = clip.tissue[index]
        signs = np.zeros((5, *tissue.shape), np.float32)
        signs[:3] = random.choice(np.array([-1, 1], np.float32), (3, *tissue.shape)) * tissue
        found = model.image_gradient(frames.cameras[index], float(frames.t[index]), signs)
        effect += found.astype(np.float64) ** 2 * (model.count / max(3 * int(tissue.sum()), 1) / len(sampled))
    effect[2] = effect[:2].mean(0) * _depth_over_place(model, clip, frames, effect, indices[len(indices) // 2], bases)
    return effect


def _depth_over_place(
    model: Model, clip: DepthClip, frames: TrainingFrames, effect: NDArray[np.float64], index: int, bases: int
) -> float:
    """How much more an error along the first camera's axis changes frame `index` than one across it, squared."""
    across = max(float(effect[:2].mean()), 1e-12)
    size = FIRST_STEP * math.sqrt(bases / (12 * across))  # so many numbers of a channel add their errors at any time
    noise = size * np.random.default_rng(0).standard_normal(model.count).astype(np.float32)
    depth = model.parameters()["canonical"][2]
    exact_depth = depth.clone()
    camera, t = frames.cameras[index], float(frames.t[index])
    exact = model.render(camera, t)[:3].copy()
    depth += torch.from_numpy(noise).to(depth.device)
    error = (model.render(camera, t)[:3] - exact)[:, clip.tissue[index]]
    depth.copy_(exact_depth)
    measured = float(np.mean(error.astype(np.float64) ** 2))
    return max(measured / size**2 / across, 1.0)
