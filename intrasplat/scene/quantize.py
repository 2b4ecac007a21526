"""Round a scene to integers, each as coarse as the picture allows.

Symbols: N Gaussians, C channels (10, 13 with colour, 14 with gloss), B bases, R < B patterns of motion per channel.

`effect` decides how much precision is lost: the mean squared change of the picture when a number changes by 1.

1. Three changes of coordinates lose nothing. A channel's mean over the trained times moves from the motion into the
   canonical state. Quaternions get length 1. Red, green and blue become a brightness and two differences.
2. Motion becomes coefficients of R patterns per channel: the principal components of all Gaussians' motions at the
   trained times. Errors of equal size in any coefficient then weigh the same in time.
3. Gaussians are sorted along a curve through the view from the world's origin, so that neighbours are alike.
4. Every number is divided by its step and rounded. The step is the channel's step, so that all channels' errors weigh
   the same in the picture, times a power of two for each Gaussian's position, shape and colour.

prepare() does steps 1 to 3, rounding() step 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.scene.compact import (
    GROUP_OF,
    MAX_NUMBERS,
    MIN_POWER,
    OPPONENT,
    PLAIN_COLUMNS,
    SEEN_LEVELS,
    Compact,
    DoesNotFitError,
    Numbers,
    Whole,
    check_size,
    state_rows,
)
from intrasplat.scene.differences import MAX_POWER, MAX_STORED
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR, COLOUR_ROW, MEAN, QUATERNION, QUATERNION_ROW

Reals = NDArray[np.float64]
Floats = NDArray[np.float32]

SHAPE = slice(QUATERNION_ROW, COLOUR_ROW)
"""Rows of quaternion and log-scale, which share one power."""
MAX_ROTATION_STEP = 2.0**MIN_POWER / 2
"""Largest step of a quaternion at power 0. A quaternion of length 1 has a number of at least 1/2, one step at the
lowest power. So none is rounded to 0, which is not a rotation."""
MIN_EFFECT = 1e-3
"""Smallest effect of a channel: one that the frames do not show at all is stored as if they showed it this much.
Rotations have 0.02, positions 0.3."""
RIDGE = 0.01
"""Added to the bases' strength, as a share of its mean: motion that no trained time shows is stored with a tenth of the
precision."""
MIN_SHOWN = 2e-5
"""Patterns that change the picture less are skipped (RMS; 1 is black to white): all their numbers round to 0 at any
step that a scene is stored with."""
CURVE_BITS = 16
COLOURS, QUATERNIONS = (range(rows.start, rows.stop) for rows in (COLOUR, QUATERNION))


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in its new coordinates and order, ready for rounding at any step.

    state    [N, S]      means over the trained times; S as in compact.py
    motion   C of [N, r] coefficients of the channel's r <= R patterns, float32
    pattern  [C, R, B]   weights of each pattern; 0 for patterns that a channel does not have
    power    [N, 3]      precision of position, shape and colour, as powers of two
    effect   [S]         RMS change of the picture when all Gaussians are off by 2**-power
    seen     [N]         in [0, 1]
    basis                the motion's bases, without weights
    """

    state: Reals
    motion: list[Floats]
    pattern: Reals
    power: Whole
    effect: Reals
    seen: Reals
    basis: SharedBasis


def prepare(
    gaussians: Gaussians,
    bases: SharedBasis,
    weight: Floats,
    seen: Tensor,
    effect: Reals,
    trained_t: Sequence[float],
) -> Prepared:
    """The scene in the coordinates in which it is rounded; no precision is lost yet.

    Args:
        bases: the motion's bases; their own weights are not read.
        weight: [B, C, N] weights of the motion, as a model stores them; read channel by channel.
        seen: [N] in [0, 1].
        effect: [VALUES, N]; an error e in a number adds effect * e**2 / N to the picture's mean squared error.
        trained_t: model times of the training frames, at least one.
    """
    order = np.argsort(_along_curve(gaussians.mean.double().numpy()), kind="stable")
    state = _state_of(gaussians)[order]
    effect = effect[:, order].copy()
    channels = weight.shape[1]
    values = np.stack([bases.basis(t).double().numpy() for t in trained_t])  # [T, B]
    mean = np.stack([values.mean(0).astype(np.float32) @ weight[:, c] for c in range(channels)], axis=1)[order]
    state[:, :channels] += mean
    length = np.linalg.norm(state[:, QUATERNION], axis=1)
    state[length == 0, QUATERNION_ROW], length[length == 0] = 1, 1  # a quaternion of zeros is not a rotation
    state[:, QUATERNION] /= length[:, None]
    effect[QUATERNION] *= length**2
    state[:, COLOUR] = state[:, COLOUR] @ OPPONENT.T
    effect[COLOUR] = effect[COLOUR].mean(0)

    power = np.stack([_power(effect[group]) for group in (MEAN, SHAPE, COLOUR)], axis=1)
    rows = state_rows(channels)
    state, effect, scale = state[:, rows], effect[rows], np.exp2(power)[:, GROUP_OF[rows]]
    root = np.maximum(np.sqrt(effect.sum(1) / (scale**2).sum(0)), MIN_EFFECT)
    weights = _channels(weight, order, mean, length.astype(np.float32))
    most = (MAX_NUMBERS // len(state) - len(rows) - PLAIN_COLUMNS) // channels
    motion, pattern = _patterns(weights, root[:channels], values, scale, max(most, 1))
    share = np.clip(seen.double().numpy(), 0, 1)[order]
    return Prepared(state, motion, pattern, power, root, share, bases.select(torch.zeros(0, dtype=torch.int64)))


@dataclass(frozen=True, eq=False)
class Rounding(Numbers):
    """A prepared scene that rounds its numbers when they are asked for: a table would take as much memory as the scene.

    step     [S] as in Numbers
    per_unit [N, S] float64, integer steps per unit, of the state and of its channels' motion
    """

    prepared: Prepared
    per_unit: Reals

    def at_rest(self) -> NDArray[np.int32]:
        return _whole(self.prepared.state * self.per_unit)

    def coefficients(self, first: int, last: int) -> NDArray[np.int32]:
        units = self.per_unit[:, first:last].astype(np.float32)
        patterns = self.pattern.shape[1]
        found: NDArray[np.int32] = np.zeros((len(units), (last - first) * patterns), np.int32)
        for place, motion in enumerate(self.prepared.motion[first:last]):
            start = place * patterns
            found[:, start : start + motion.shape[1]] = _whole(motion * units[:, place, None])
        return found

    def powers(self) -> Whole:
        return self.prepared.power

    def compact(self) -> Compact:
        """The same in one table. It frees the prepared motion, so that nothing else can be rounded afterwards."""
        channels, patterns, _ = self.pattern.shape
        first = len(self.step)
        columns = first + channels * patterns + PLAIN_COLUMNS
        table: NDArray[np.int32] = np.empty((len(self.prepared.power), columns), np.int32)
        table[:, :first] = self.at_rest()
        for channel in range(channels):
            table[:, first : first + patterns] = self.coefficients(channel, channel + 1)
            self.prepared.motion[channel] = np.zeros((0, 0), np.float32)
            first += patterns
        table[:, -4:-1] = self.powers()
        # Do not round a positive `seen` to 0: a render marks what was not seen.
        seen = self.prepared.seen
        table[:, -1] = np.maximum(np.rint(seen * SEEN_LEVELS), seen > 0)
        return Compact(self.step, self.pattern, self.centre, self.width, table)


def rounding(prepared: Prepared, step: float) -> Rounding:
    """The scene with every number rounded to a multiple of its step.

    The methods of the result raise DoesNotFitError where a number would exceed MAX_STORED.

    Args:
        step: change of the picture (1 is black to white) when all Gaussians' numbers of one kind are off by one step.

    Raises:
        DoesNotFitError: there would be more than MAX_NUMBERS numbers.
    """
    channels, patterns, _ = prepared.pattern.shape
    rows = state_rows(channels)
    check_size(len(prepared.power), len(rows) + channels * patterns + PLAIN_COLUMNS)
    steps = step / prepared.effect
    steps[QUATERNION] = np.minimum(steps[QUATERNION], MAX_ROTATION_STEP)
    pattern = np.ascontiguousarray(prepared.pattern * steps[:channels, None, None], np.float32)
    per_unit = np.exp2(prepared.power)[:, GROUP_OF[rows]] / steps
    basis = prepared.basis
    return Rounding(steps.astype(np.float32), pattern, basis.centre, basis.width, prepared, per_unit)


def _whole(numbers: NDArray[np.floating]) -> NDArray[np.int32]:
    """The numbers rounded; the input array is overwritten.

    Raises:
        DoesNotFitError: a number would exceed MAX_STORED.
    """
    largest = max(-float(numbers.min(initial=0)), float(numbers.max(initial=0)))
    if not largest <= MAX_STORED:
        raise DoesNotFitError(f"the step is so fine that a number becomes {largest:g}")
    whole: NDArray[np.int32] = np.rint(numbers, out=numbers).astype(np.int32)
    return whole


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


def _channels(weight: Floats, order: Whole, mean: Floats, length: Floats) -> Iterator[Floats]:
    """Each channel's weights [N, B] in the new coordinates and order, one by one to save memory.

    weight: [B, C, N] in the old order. mean [N, C] over the trained times, length [N] of quaternions: in the new order.
    """

    def ordered(row: int) -> Floats:
        """[B, N] weights of one channel less its mean, which each weight contains, because the bases sum to 1."""
        found = np.empty((len(weight), len(order)), np.float32)
        for at_basis, kept in zip(weight, found, strict=True):
            np.take(at_basis[row], order, out=kept, mode="clip")  # mode "raise" would make one more copy
        return np.subtract(found, mean[:, row], out=found)

    for row in range(weight.shape[1]):
        if row in COLOURS:
            shares = OPPONENT[row - COLOUR_ROW].astype(np.float32)
            yield sum(share * ordered(COLOUR_ROW + place) for place, share in enumerate(shares)).T
        elif row in QUATERNIONS:
            yield (ordered(row) / length).T
        else:
            yield ordered(row).T


def _patterns(
    weights: Iterable[Floats], effect: Reals, values: Reals, scale: Reals, most: int
) -> tuple[list[Floats], Reals]:
    """Coefficients, C of [N, r], and patterns [C, R, B] of C channels' weights [N, B], whose mean over the times is 0.

    A channel gets its strongest patterns, at most `most`, without those below MIN_SHOWN. effect: [C] as in Prepared.
    values: [T, B] bases at the trained times. scale: [N, C or more] precision of each Gaussian's channel.
    """
    bases = values.shape[1]
    strength = values.T @ values / len(values)
    strength += RIDGE * np.trace(strength) / bases * np.eye(bases)
    root = np.linalg.cholesky(strength)  # in these coordinates equal errors weigh the same over the trained times
    coefficients, patterns = [], []
    for channel, weight in enumerate(weights):
        seen = weight @ root.astype(np.float32)
        scaled = seen * scale[:, channel, None].astype(np.float32)
        energy, components = np.linalg.eigh((scaled.T @ scaled).astype(np.float64))
        shown = effect[channel] * np.sqrt(np.maximum(energy[:0:-1], 0) / len(scale))  # effect of each pattern
        kept = components[:, :0:-1]  # the weakest is 0, because the mean over time is taken out
        kept = kept[:, : min(int((shown >= MIN_SHOWN).sum()), most)]
        coefficients.append(seen @ kept.astype(np.float32))
        patterns.append(np.linalg.solve(root.T, kept).T)
    stored = np.zeros((len(patterns), max(len(each) for each in patterns), bases))
    for found, rows in zip(patterns, stored, strict=True):
        rows[: len(found)] = found
    return coefficients, stored


def _along_curve(mean: Reals) -> Whole:
    """[N] positions along a Hilbert curve through the first frame's view; mean: [N, 3] in optimiser units."""
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
