"""The coarsest quantisation step of a scene whose measured loss on training frames stays within a tolerance.

Symbols: N Gaussians. Held-out frames are not used.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.clip import spread
from intrasplat.notices import Notice, NoticeCode
from intrasplat.scene.compact import DoesNotFitError, Numbers
from intrasplat.scene.model import model_of
from intrasplat.scene.quantize import Prepared, Rounding, prepare, rounding
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.layout import OPACITY_ROW, ROWS, VALUES
from intrasplat.splat.model import Model
from intrasplat.train.targets import TrainingFrames

Picture = tuple[TrainingFrames, int]
"""An eye and one of its training frames."""
TOLERANCE_DB = 0.1
"""The most psnr_tissue that a stored scene may lose on training frames. Held-out frames of a real clip lost 0.06 dB."""
SENSITIVITY_FRAMES = 12
"""Training frames in which the sensitivity to each number is measured."""
SCORED_FRAMES = 8
MAX_TRIALS = 6
ENOUGH = 0.85
"""The trials end with one that uses at least this share of the tolerance."""
MIN_STEP, MAX_FIRST_STEP = 1e-5, 4e-3
"""Colours; 1 is white."""
FIRST_STEP = 0.36
"""The first step tried, as a share of the picture's RMS error over the square root of the numbers per Gaussian. Scenes
of 29 to 40 dB ended within a sixth of it."""
NOISE_STEP = 4e-4
"""Colour, 1 is white: the step at which the sensitivity to depth is measured."""
RATE_EXPONENT = 1.7
"""The distortion grows about as this power of the step (1.2 to 2.2 were measured): as its square for fine steps, more
slowly where most numbers are 0 already."""
SAFETY = 0.95
"""Factor on the predicted step, so that the next trial most likely stays within the tolerance."""


@dataclass(frozen=True, eq=False)
class QuantizedScene:
    """A scene as it will be read back, and what quantisation cost.

    scene        the model after rounding, its numbers in scene.stored
    step         mean change of the picture by one step of a number; 1 is from black to white
    loss_db      psnr_tissue lost on so many training `frames`
    float_bytes  size of the model before
    """

    scene: TrainedScene
    step: float
    loss_db: float
    frames: int
    float_bytes: int

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What was chosen, for the report."""
        text = (
            f"Numbers are stored in steps that change the picture by {255 * self.step:.2g} of 255: "
            f"{self.scene.file_bytes / 1e6:.2f} MB instead of {self.float_bytes / 1e6:.1f}, for {self.loss_db:.2f} dB "
            f"on {self.frames} training frames. All scores are of the stored scene."
        )
        return (Notice.info(NoticeCode.STORED_PRECISION, text),)

    @property
    def measurements(self) -> dict[str, float]:
        """Step and loss for the report, by name."""
        return {"stored_step": self.step, "stored_loss_db": self.loss_db}


@dataclass(frozen=True, eq=False)
class RoundedModel:
    """A model in whole numbers; step, loss_db and frames as in QuantizedScene."""

    rounding: Rounding
    step: float
    loss_db: float
    frames: int

    def stored(self, scene: TrainedScene) -> QuantizedScene:
        """The scene with the model as it will be read back. It consumes the rounding and needs no float model."""
        compact = self.rounding.compact()
        stored = compact.tensors()
        gaussians, deformation, seen = compact.model()
        small = dataclasses.replace(scene, gaussians=gaussians, deformation=deformation, seen=seen, stored=stored)
        return QuantizedScene(small, self.step, self.loss_db, self.frames, small.byte_count)


def round_model(
    model: Model,
    scene: TrainedScene,
    eyes: Sequence[TrainingFrames],
    tolerance_db: float = TOLERANCE_DB,
    device: Device = CPU,
    on_step: Callable[[], None] = lambda: None,
    limit_s: float = math.inf,
) -> RoundedModel | None:
    """The model in whole numbers; None if it is stored as floats, or if no trial stayed within the tolerance.

    Args:
        scene: of this model; its motion needs no weights.
        eyes: targets of the eyes that were trained on.
        on_step: called between two parts of the work.
        limit_s: no trial begins later than this if one has stayed within the tolerance.
    """
    began_s = time.monotonic()
    pictures = [(frames, index) for index in eyes[0].indices for frames in eyes if frames.eye.tissue[index].any()]
    if not isinstance(scene.deformation, SharedBasis) or scene.gaussians.sh_degree > 0 or not pictures:
        return None
    scored = _spread(pictures, SCORED_FRAMES)
    exact_db = _mean_db((model.render(frames.cameras[i], float(frames.t[i])) for frames, i in scored), scored)
    if not math.isfinite(exact_db):
        return None
    on_step()
    sensitivity = _sensitivity(model, pictures, len(scene.deformation.centre))
    times = [float(eyes[0].t[index]) for index in eyes[0].indices]

    def loss_db(numbers: Numbers) -> float:
        on_step()
        return exact_db - _mean_db(_renders(numbers, scene, scored, device), scored)

    on_step()
    weight = model.parameters()["motion.weight"].cpu().numpy()
    prepared = prepare(scene.gaussians, scene.deformation, weight, scene.seen, sensitivity, times)
    found = _coarsest(
        lambda step: loss_db(rounding(prepared, step)),
        _first_step(prepared, exact_db),
        tolerance_db,
        lambda: time.monotonic() - began_s > limit_s,
    )
    return None if found is None else RoundedModel(rounding(prepared, found[0]), *found, len(scored))


def _first_step(prepared: Prepared, exact_db: float) -> float:
    """The step to try first: in proportion to the picture's error, over the root of the numbers per Gaussian."""
    numbers = prepared.state.shape[1] + sum(motion.shape[1] for motion in prepared.motion)
    error = 10 ** (-exact_db / 20)
    return min(max(FIRST_STEP * error / math.sqrt(numbers), 2 * MIN_STEP), MAX_FIRST_STEP)


def _coarsest(
    loss_of: Callable[[float], float],
    first: float,
    tolerance_db: float,
    is_late: Callable[[], bool] = lambda: False,
) -> tuple[float, float] | None:
    """The coarsest step tried that stayed within the tolerance, and its loss in dB; None if none did.

    Each trial predicts the step that just uses the tolerance. Once is_late(), the first such step ends the trials.
    """
    step, good, bad, best = first, MIN_STEP, math.inf, None
    for _ in range(MAX_TRIALS):
        if best is not None and is_late():
            break
        try:
            loss_db = loss_of(step)
        except DoesNotFitError:
            loss_db = math.inf
        if not loss_db <= tolerance_db:
            bad = min(bad, step)
        elif step > good:
            good, best = step, (step, loss_db)
            if loss_db >= ENOUGH * tolerance_db:
                break
        allowed = _added_error(tolerance_db)
        predicted = SAFETY * step * (allowed / max(_added_error(loss_db), 1e-2 * allowed)) ** (1 / RATE_EXPONENT)
        step = predicted if good < predicted < bad else math.sqrt(good * min(bad, 100 * good))
    return best


def _added_error(loss_db: float) -> float:
    """The squared error that a loss of so many dB adds, as a share of the squared error before."""
    return float(10 ** (loss_db / 10) - 1)


def _spread(pictures: Sequence[Picture], count: int) -> list[Picture]:
    """At most count pictures, evenly spread over the clip."""
    return [pictures[place] for place in spread(range(len(pictures)), count)]


def _mean_db(images: Iterable[NDArray[np.float32]], scored: Sequence[Picture]) -> float:
    return float(np.mean([frames.psnr_tissue_db(i, image) for (frames, i), image in zip(scored, images, strict=True)]))


def _renders(
    numbers: Numbers, scene: TrainedScene, scored: Sequence[Picture], device: Device
) -> Iterator[NDArray[np.float32]]:
    """The scored frames, rendered from what would be stored. Only the Gaussians at their times are decoded."""
    rest = SharedBasis.initial(len(scene.gaussians), bases=1)
    still = model_of(dataclasses.replace(scene, deformation=rest), device)
    canonical, opacity_logit = (still.parameters()[name] for name in ("canonical", "opacity_logit"))
    times = [float(frames.t[index]) for frames, index in scored]
    for (frames, index), numbers_then in zip(scored, numbers.at(times), strict=True):
        then = torch.from_numpy(numbers_then)
        canonical.copy_(then[:ROWS])
        opacity_logit.copy_(then[OPACITY_ROW])
        yield still.render(frames.cameras[index], 0.0)


def _sensitivity(model: Model, pictures: Sequence[Picture], bases: int) -> NDArray[np.float64]:
    """[VALUES, N]: an error e in a number adds sensitivity * e**2 / N to the mean squared error of the tissue's pixels.

    The square of a pixel's derivative, summed over the pixels, is the mean square of the gradient of their sum with
    random signs: one gradient per frame gives all of them (Hutchinson 1990).

    A depth also decides which of two Gaussians hides the other, and that has no derivative. Its sensitivity is
    therefore measured once for all Gaussians, with noise of the size that rounding makes.
    """
    random, sampled = np.random.default_rng(0), _spread(pictures, SENSITIVITY_FRAMES)
    sensitivity = np.zeros((VALUES, model.count))
    for frames, index in sampled:
        tissue = frames.eye.tissue[index]
        signs = np.zeros((5, *tissue.shape), np.float32)
        signs[:3] = (2 * random.integers(0, 2, (3, *tissue.shape), np.int8) - 1) * tissue
        found = model.image_gradient(frames.cameras[index], float(frames.t[index]), signs)
        sensitivity += found.astype(np.float64) ** 2 * (model.count / max(3 * int(tissue.sum()), 1) / len(sampled))
    across = max(float(sensitivity[:2].mean()), 1e-12)
    sensitivity[2] = sensitivity[:2].mean(0) * _depth_over_place(model, pictures[len(pictures) // 2], across, bases)
    return sensitivity


def _depth_over_place(model: Model, picture: Picture, across: float, bases: int) -> float:
    """The squared change of a picture by an error along the first camera's axis, over that by one across the axis.

    `across` is the mean sensitivity to an error across the axis.
    """
    size = NOISE_STEP * math.sqrt(bases / (12 * across))  # at any time a channel adds the errors of `bases` numbers
    noise = size * np.random.default_rng(0).standard_normal(model.count).astype(np.float32)
    depth = model.parameters()["canonical"][2]
    exact_depth = depth.clone()
    frames, index = picture
    camera, t = frames.cameras[index], float(frames.t[index])
    exact = model.render(camera, t)[:3].copy()
    depth += torch.from_numpy(noise).to(depth.device)
    error = (model.render(camera, t)[:3] - exact)[:, frames.eye.tissue[index]]
    depth.copy_(exact_depth)
    measured = float(np.mean(error.astype(np.float64) ** 2))
    return max(measured / size**2 / across, 1.0)
