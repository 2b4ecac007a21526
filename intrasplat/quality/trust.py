"""The trust in each Gaussian: the probability that it is right, estimated from training frames.

Symbols: N Gaussians, H W pixels.

Two numbers from the training frames predict the errors of other views: how many of them saw the Gaussian, and the error
of the pixels that it contributes to (docs/decisions/views.md has the rank correlations).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import Eye, spread
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.layout import COLOUR
from intrasplat.splat.metrics import RIGHT_COLOUR, RIGHT_DEPTH
from intrasplat.splat.model import Model
from intrasplat.train.targets import TrainingFrames

SAMPLED_PICTURES = 24
"""Number of training frames of all eyes that are sampled, evenly spread: enough for shares to a few per cent."""
MIN_TISSUE_PX = 0.5
"""A frame sees a Gaussian if its weights on tissue add up to so many pixels; hidden Gaussians reach less."""
MIN_TISSUE_SHARE = 0.2
"""And if they are this share of all its weights there. At an instrument's edge, the visible part fixes the rest."""

MAX_DEPTH_ERROR = 10 * RIGHT_DEPTH
"""Larger relative errors of depth are clamped to it."""
LEAST = np.array([0.03, 0.05])
"""Added to share and error before the logarithm: smaller differences carry no information."""
WEIGHTS = np.array([0.66, -1.22])
"""Weights of the logarithms of share and error. `python -m lab.benchmarks.bm_confidence --fit` finds them."""
BIAS = 2.3
LEAST_TRUST = 1 / 63
"""Smallest trust of a Gaussian that was seen at all: 0 means not seen."""


def trust(model: Model, eyes: Sequence[TrainingFrames]) -> NDArray[np.float32]:
    """[N] in [0, 1]: the probability that a Gaussian is right; 0 if no training frame saw it."""
    return trust_of(evidence(model, eyes))


def trust_of(found: NDArray[np.floating]) -> NDArray[np.float32]:
    """[N] the trust that evidence [2, N] gives."""
    likely = 1 / (1 + np.exp(-(WEIGHTS @ logarithms(found) + BIAS)))
    return np.where(found[0] > 0, np.clip(likely, LEAST_TRUST, 1), 0).astype(np.float32)


def logarithms(found: NDArray[np.floating]) -> NDArray[np.floating]:
    """[2, N] logarithms of the evidence [2, N]; trust is a logistic function of them."""
    return np.asarray(np.log(found + LEAST[:, None]))


def evidence(model: Model, eyes: Sequence[TrainingFrames]) -> NDArray[np.float64]:
    """[2, N]: share of training frames that saw the Gaussian, for the eye that saw it more often; and mean error of the
    pixels that showed it, where 1 is the largest error that counts as right.
    """
    sampled = spread(eyes[0].indices, max(SAMPLED_PICTURES // len(eyes), 1))
    seen = np.zeros((len(eyes), model.count))
    on_tissue, error = np.zeros((2, model.count))
    for index in sampled:
        for place, frames in enumerate(eyes):
            camera, t = frames.cameras[index], float(frames.t[index])
            here, drawn, wrong = weights_in(model, camera, t, frames.eye, index, frames.scale)
            seen[place] += sees(here, drawn)
            on_tissue += here
            error += wrong
            frames.eye.let_go(index)
    mean_error = np.maximum(error, 0) / np.maximum(on_tissue, 1e-6)
    return np.stack([seen.max(0) / len(sampled), mean_error])


def sees(on_tissue: NDArray[np.floating], drawn: NDArray[np.floating]) -> NDArray[np.floating]:
    """[N] how much a frame saw each Gaussian, in [0, 1], by its weights on tissue and in the whole picture."""
    seen = (on_tissue >= MIN_TISSUE_PX) & (on_tissue >= MIN_TISSUE_SHARE * drawn)
    return np.where(seen, np.minimum(on_tissue / np.where(seen, drawn, 1), 1), 0)


def weights_in(
    model: Model, camera: NDArray[np.float64], t: float, eye: Eye, index: int, scale: float
) -> NDArray[np.floating]:
    """[3, N]: each Gaussian's blending weights in an eye's frame `index`, summed over tissue, over all pixels, and over
    tissue times the pixel's error.

    A Gaussian's weights, summed over chosen pixels, are the gradient of a colour summed over them.

    Args:
        camera, t: the eye's camera, and the model's time of the frame.
        scale: optimiser units per mm.
    """
    tissue = eye.tissue[index]
    cotangents = np.zeros((5, *tissue.shape), np.float32)
    cotangents[2] = tissue * _errors(eye, index, scale, model.render(camera, t))
    cotangents[0], cotangents[1] = tissue, 1
    return np.asarray(model.image_gradient(camera, t, cotangents)[COLOUR] / np.float32(SH_C0))


def _errors(eye: Eye, index: int, scale: float, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W] sum of the errors of colour and depth, each divided by the largest that counts as right. Depth that stereo
    did not measure is a guess: its error counts as 1.
    """
    colour = np.abs(np.clip(image[:3], 0, 1) - eye.rgb[index].transpose(2, 0, 1) / np.float32(255)).mean(0)
    shown_mm = image[3] / np.maximum(image[4], 1e-3) / np.float32(scale)
    measured = eye.depth_mm[index] > 0
    relative = np.abs(shown_mm / np.where(measured, eye.depth_mm[index], 1) - 1)
    depth = np.where(measured, np.minimum(relative, MAX_DEPTH_ERROR), RIGHT_DEPTH)
    return np.asarray(colour / RIGHT_COLOUR + depth / RIGHT_DEPTH, np.float32)
