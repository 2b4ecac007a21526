"""Turn a scene into whole numbers: each as coarse as the picture allows.

Symbols: N Gaussians, C channels (10, 13 with colour, 14 with gloss), B bases, R = B - 1 patterns of motion per channel.

`effect` decides what is lost: the mean squared change of the picture that a change of 1 in a number makes.

1. Three changes of coordinates lose nothing. A channel's mean over the trained times moves from the motion into the
   canonical state. Quaternions get length 1. Red, green and blue become a brightness and two differences.
2. Motion becomes coefficients of R patterns per channel: the principal components of all Gaussians' motions at the
   trained times. Errors of equal size in any coefficient then weigh the same in time.
3. Gaussians are sorted along a curve through the view from the world's origin, so that neighbours are alike.
4. Every number is divided by its step and rounded. The step is the channel's own, so that all channels' errors weigh
   the same in the picture, times a power of two for each Gaussian's place, shape and colour.

prepare() does steps 1 to 3, round_to() step 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.model.deformation import SharedBasis
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS, COLOUR, COLOUR_ROW, MEAN, QUATERNION, QUATERNION_ROW
from worker.scene.compact import GROUP_OF, MIN_POWER, OPPONENT, SEEN_LEVELS, Compact, Whole, check_size, state_rows
from worker.scene.differences import MAX_POWER, MAX_STORED

Reals = NDArray[np.float64]

SHAPE = slice(QUATERNION_ROW, COLOUR_ROW)
"""Quaternion and log-scale, whose precision is one power."""
MAX_ROTATION_STEP = 2.0**MIN_POWER / 2
"""Of a quaternion at power 0. One of length 1 has a number of at least 1/2, which is one step at the lowest power, so
no quaternion is rounded to 0, which is not a rotation."""
MIN_EFFECT = 1e-3
"""A channel that the frames do not show at all is stored as if they showed it so much. Rotations have 0.02, places
0.3."""
RIDGE = 0.01
"""Added to the bases' strength, as a share of its mean: motion that no trained time shows keeps a tenth of the
precision."""
CURVE_BITS = 16


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in its new coordinates and order, ready for rounding at any step.

    state    [N, S]      means over the trained times; S as in compact.py
    motion   [C, N, R]   coefficients of the patterns, float32
    pattern  [C, R, B]   weights of each pattern
    power    [N, 3]      precision of place, shape and colour, as powers of two
    effect   [S]         RMS change of the picture when all Gaussians are off by 2**-power
    seen     [N]         in [0, 1]
    basis                of the motion; only its centre and width are read
    """

    state: Reals
    motion: NDArray[np.float32]
    pattern: Reals
    power: Whole
    effect: Reals
    seen: Reals
    basis: SharedBasis


def prepare(
    gaussians: Gaussians, deformation: SharedBasis, seen: Tensor, effect: Reals, trained_t: Sequence[float]
) -> Prepared:
    """The scene in the coordinates in which it is rounded; nothing is lost yet.

    Args:
        seen: [N] in [0, 1].
        effect: [VALUES, N]; an error e in a number adds effect * e**2 / N to the picture's mean squared error.
        trained_t: model times of the training frames, at least one.
    """
    order = np.argsort(_along_curve(gaussians.mean.double().numpy()), kind="stable")
    state = _state_of(gaussians)[order]
    weight = deformation.weight.numpy()[order]
    effect = effect[:, order].copy()
    channels = weight.shape[1]
    values = np.stack([deformation.basis(t).double().numpy() for t in trained_t])  # [T, B]
    mean = weight @ values.mean(0).astype(np.float32)
    state[:, :channels] += mean
    weight -= mean[:, :, None]  # the bases sum to 1
    length = np.linalg.norm(state[:, QUATERNION], axis=1)
    state[length == 0, QUATERNION_ROW], length[length == 0] = 1, 1  # zeros are not a rotation
    state[:, QUATERNION] /= length[:, None]
    weight[:, QUATERNION] /= length[:, None, None].astype(np.float32)
    effect[QUATERNION] *= length**2
    state[:, COLOUR] = state[:, COLOUR] @ OPPONENT.T
    effect[COLOUR] = effect[COLOUR].mean(0)
    if channels > CHANNELS:
        weight[:, COLOUR] = OPPONENT.astype(np.float32) @ weight[:, COLOUR]

    power = np.stack([_power(effect[group]) for group in (MEAN, SHAPE, COLOUR)], axis=1)
    rows = state_rows(channels)
    state, effect, scale = state[:, rows], effect[rows], np.exp2(power)[:, GROUP_OF[rows]]
    root = np.maximum(np.sqrt(effect.sum(1) / (scale**2).sum(0)), MIN_EFFECT)
    motion, pattern = _patterns(weight, values, scale)
    share = np.clip(seen.double().numpy(), 0, 1)[order]
    return Prepared(state, motion, pattern, power, root, share, deformation)


def round_to(prepared: Prepared, step: float) -> Compact:
    """The scene with every number rounded to a multiple of its step.

    Args:
        step: change of the picture (1 is black to white) when all Gaussians' numbers of one kind are off by one step.

    Raises:
        ValueError: a number would exceed MAX_STORED, or there would be more than MAX_NUMBERS.
    """
    channels, count, patterns = prepared.motion.shape
    rows = state_rows(channels)
    columns = len(rows) + channels * patterns + 4
    check_size(count, columns)
    steps = step / prepared.effect
    steps[QUATERNION] = np.minimum(steps[QUATERNION], MAX_ROTATION_STEP)
    table: NDArray[np.int32] = np.empty((count, columns), np.int32)

    def fill(first: int, numbers: NDArray[np.floating]) -> None:
        largest = max(-float(numbers.min(initial=0)), float(numbers.max(initial=0)))
        if not largest <= MAX_STORED:
            raise ValueError(f"a step of {step:g} makes numbers as large as {largest:g}")
        table[:, first : first + numbers.shape[1]] = np.rint(numbers, out=numbers)

    units = np.exp2(prepared.power)[:, GROUP_OF[rows]] / steps  # [N, S]
    fill(0, prepared.state * units)
    for channel, motion in enumerate(prepared.motion):
        fill(len(rows) + channel * patterns, motion * units[:, channel, None].astype(np.float32))
    table[:, -4:-1] = prepared.power
    # What was seen at all stays so: a render marks what was not.
    levels = np.maximum(np.rint(prepared.seen * SEEN_LEVELS), prepared.seen > 0)
    fill(columns - 1, levels[:, None])
    pattern = np.ascontiguousarray(prepared.pattern * steps[:channels, None, None], np.float32)
    basis = prepared.basis
    return Compact(table, steps.astype(np.float32), pattern, basis.centre, basis.width)


def _state_of(gaussians: Gaussians) -> Reals:
    columns = [
        gaussians.mean,
        gaussians.quaternion,
        gaussians.log_scale,
        gaussians.sh[:, 0],
        gaussians.gloss[:, None],
        gaussians.opacity_logit[:, None],
    ]
    state: Reals = torch.cat(columns, 1).double().numpy()
    return state


def _power(effect: Reals) -> Whole:
    """[N] power of two nearest to each Gaussian's RMS effect relative to the mean; effect [channels, N]."""
    mean = effect.mean(1, keepdims=True)
    relative = np.mean(effect / np.where(mean > 0, mean, 1), axis=0)
    nearest = np.rint(np.log2(np.maximum(relative, 1e-12)) / 2)
    power: Whole = np.clip(nearest, MIN_POWER, MAX_POWER).astype(np.int64)
    return power


def _patterns(weight: NDArray[np.float32], values: Reals, scale: Reals) -> tuple[NDArray[np.float32], Reals]:
    """Coefficients [C, N, R] and patterns [C, R, B] of weights [N, C, B] whose mean over the times is 0.

    values [T, B] of the bases at the trained times; scale [N, C or more], precision of each Gaussian's channel.
    """
    bases = values.shape[1]
    strength = values.T @ values / len(values)
    strength += RIDGE * np.trace(strength) / bases * np.eye(bases)
    root = np.linalg.cholesky(strength)  # in these coordinates equal errors weigh the same over the trained times
    coefficients = np.empty((weight.shape[1], len(weight), bases - 1), np.float32)
    patterns = np.empty((weight.shape[1], bases - 1, bases))
    for channel in range(weight.shape[1]):
        seen = weight[:, channel] @ root.astype(np.float32)
        scaled = seen * scale[:, channel, None].astype(np.float32)
        _, components = np.linalg.eigh((scaled.T @ scaled).astype(np.float64))
        kept = components[:, :0:-1]  # the weakest is 0, because the mean over time is taken out
        coefficients[channel] = seen @ kept.astype(np.float32)
        patterns[channel] = np.linalg.solve(root.T, kept).T
    return coefficients, patterns


def _along_curve(mean: Reals) -> Whole:
    """[N] places along a Hilbert curve through the first frame's view; mean [N, 3] in optimiser units."""
    direction = mean[:, :2] / np.maximum(mean[:, 2:], 1.0)
    direction -= direction.min(0)
    size = 1 << CURVE_BITS
    x, y = (direction * ((size - 1) / max(direction.max(), 1e-12))).astype(np.int64).T
    place = np.zeros(len(mean), np.int64)
    for bit in range(CURVE_BITS - 1, -1, -1):
        right, up = x >> bit & 1, y >> bit & 1
        place += (3 * right ^ up) << 2 * bit
        x, y = np.where(right & ~up, size - 1 - x, x), np.where(right & ~up, size - 1 - y, y)
        x, y = np.where(up, x, y), np.where(up, y, x)
    return place
