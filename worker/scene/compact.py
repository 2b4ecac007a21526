"""A scene's numbers as few bytes: each as coarse as the picture allows, then packed by the range coder.

Symbols: N Gaussians, C channels (10, or 13 with colour), B bases, R = B - 1 patterns of motion a channel, K columns.

What is lost is decided by `effect`: the mean squared change of the picture that a change of 1 in a number makes.

1. What changes nothing: a channel's mean over the trained times moves from the motion into the canonical state;
   quaternions get length 1; red, green and blue become a brightness and two differences.
2. Motion becomes coefficients of R patterns a channel: the principal components of all Gaussians' motions, as the
   trained times see them. Errors of equal size in any coefficient then weigh the same in time.
3. Every number is divided by its step and rounded. A step is a channel's own, so that all channels' errors weigh the
   same in the picture, times a power of two a Gaussian, for its place, its shape and its colour.
4. Gaussians are put in order along a curve through the view from the world's origin; where neighbours are alike,
   every second number is replaced by its difference from the mean of the two beside it, then every second of those
   left, and so on.

Steps 2 to 4 are what the decoder undoes; docs/scene-file.md describes the file for other readers.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.model.deformation import CHANNELS, SharedBasis
from worker.model.deformation.shared import CHANNELS_WITH_COLOUR
from worker.model.gaussians import Gaussians
from worker.scene.differences import FINEST, LARGEST_STORED, add_differences, take_differences, told_order
from worker.scene.rangecoder import PARTS, decode, encode

Reals = NDArray[np.float64]
Whole = NDArray[np.int64]
Floats = NDArray[np.float32]

STATE = 14
"""Numbers of a Gaussian at rest: mean 0:3, quaternion 3:7, log-scale 7:10, colour 10:13, opacity logit."""
PLACE, SHAPE, COLOUR, OPACITY = slice(0, 3), slice(3, 10), slice(10, 13), 13
GROUP_OF = np.array([0] * 3 + [1] * 7 + [2] * 4)
"""Which power belongs to each number of the state: of place, shape or colour."""
PLAIN = 3
"""Group of the last columns, the powers and seen, whose steps are 1."""
COARSEST = -3
"""Least power of two, FINEST being the largest, by which a Gaussian's precision may differ from the mean: what the
trained frames hardly show may be seen from elsewhere, so it keeps an eighth."""
COARSEST_ROTATION = 2.0**COARSEST / 2
"""Largest step of a quaternion at power 0. One of length 1 has a number of at least 1/2: at the coarsest power that is
one step, and so none is rounded to nothing, which would be no rotation at all."""
LEAST_EFFECT = 1e-3
"""A channel that the frames do not show at all is stored as if they showed it so much. Rotations have 0.02, places
0.3."""
SEEN_LEVELS = 63
RIDGE = 0.01
"""Of the bases' mean strength, added to each: motion that no trained time shows keeps a tenth of the precision."""
MOST_NUMBERS = 2**27
"""Numbers a scene may have, four times those of 80 thousand Gaussians and 33 bases. Unpacking takes up to 14 bytes
a number (where there is one basis; 10 where there are many), so no file, however small, takes more than 2 GiB."""
CURVE_BITS = 16
_OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Orthonormal: brightness, red - blue, magenta - green."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in its new coordinates and order, to be rounded at any step.

    state    [N, STATE]  means over the trained times
    motion   [C, N, R]   coefficients of the patterns, float32
    pattern  [C, R, B]   weights of each pattern
    power    [N, 3]      of two: precision of place, shape and colour
    effect   [STATE]     root mean squared change of the picture by errors of 2**-power in all Gaussians
    seen     [N]         in [0, 1]
    basis                its centre and width are kept, its weight is not read
    """

    state: Reals
    motion: NDArray[np.float32]
    pattern: Reals
    power: Whole
    effect: Reals
    seen: Reals
    basis: SharedBasis


@dataclass(frozen=True, eq=False)
class Compact:
    """A scene in whole numbers.

    table    [N, K] int32     columns: STATE, then R motion coefficients a channel, then the 3 powers, then seen
    step     [STATE] float32  of the state at power 0
    pattern  [C, R, B] float32  weights of one unit of a motion coefficient at power 0
    centre, width  [B] float32  of the bases
    """

    table: NDArray[np.int32]
    step: NDArray[np.float32]
    pattern: NDArray[np.float32]
    centre: Tensor
    width: Tensor

    def model(self) -> tuple[Gaussians, SharedBasis, Tensor]:
        """Gaussians, motion and seen [N], as floats."""
        weight = torch.from_numpy(self._motion(self.pattern))
        share = torch.from_numpy(self.table[:, -1].astype(np.float32) / np.float32(SEEN_LEVELS))
        return _gaussians_of(self._state()), SharedBasis(weight, self.centre, self.width), share

    def at(self, times: Sequence[float]) -> Iterator[Gaussians]:
        """The Gaussians at each of some model times: what model()'s deformation gives, without its weights."""
        bases = SharedBasis(torch.zeros(0, CHANNELS, len(self.centre)), self.centre, self.width)
        values = np.stack([bases.basis(t).numpy() for t in times], 1)  # [B, times]
        state, motion = self._state(), self._motion(self.pattern @ values)
        for place in range(len(times)):
            moved = state.copy()
            moved[:, : motion.shape[1]] += motion[:, :, place]
            yield _gaussians_of(moved)

    def _scale(self, group: int) -> Floats:
        """[N] of the powers of a group."""
        return np.exp2(-self.table[:, -4 + group].astype(np.float32))  # exact

    def _state(self) -> Floats:
        """[N, STATE], colour as red, green and blue."""
        scales = [self._scale(group) for group in range(PLAIN)]
        state = np.empty((len(self.table), STATE), np.float32)
        for column, group in enumerate(GROUP_OF):
            state[:, column] = self.table[:, column] * (scales[group] * self.step[column])
        state[:, COLOUR] = state[:, COLOUR] @ _OPPONENT.astype(np.float32)
        return state

    def _motion(self, pattern: Floats) -> Floats:
        """[N, C, X] the motion's numbers times patterns [C, R, X], colour as red, green and blue."""
        channels, patterns, columns = pattern.shape
        motion = np.empty((len(self.table), channels, columns), np.float32)

        def numbers(first: int, last: int) -> Floats:
            block = self.table[:, STATE + first * patterns : STATE + last * patterns].astype(np.float32)
            block *= self._scale(GROUP_OF[first])[:, None]
            return block

        for channel in range(CHANNELS):
            motion[:, channel] = numbers(channel, channel + 1) @ pattern[channel]
        if channels == CHANNELS_WITH_COLOUR:
            mixed = np.einsum("or,opx->oprx", _OPPONENT.astype(np.float32), pattern[COLOUR])
            colour = numbers(CHANNELS, channels) @ mixed.reshape(3 * patterns, 3 * columns)
            motion[:, COLOUR] = colour.reshape(-1, 3, columns)
        return motion

    def tensors(self) -> dict[str, Tensor]:
        """What is stored: the table, differenced where that helps, and coded; the rest as it is."""
        stored, shared = take_differences(self.table, _powers(self.table), _group(self.pattern.shape))
        codes = [torch.from_numpy(np.frombuffer(code, np.uint8).copy()) for code in encode(stored)]
        return {
            "count": torch.tensor([len(self.table)]),
            "step": torch.from_numpy(self.step),
            "pattern": torch.from_numpy(self.pattern),
            "centre": self.centre,
            "width": self.width,
            "shared": torch.from_numpy(shared.astype(np.uint8)),
            **{f"code.{part}": code for part, code in enumerate(codes)},
        }


def prepare(
    gaussians: Gaussians, deformation: SharedBasis, seen: Tensor, effect: Reals, trained_t: Sequence[float]
) -> Prepared:
    """The change of coordinates, which loses nothing.

    Args:
        seen: [N] in [0, 1].
        effect: [STATE, N], of each number: an error e in it adds effect * e**2 / N to the picture's mean squared error.
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
    length = np.linalg.norm(state[:, 3:7], axis=1)
    state[length == 0, 3], length[length == 0] = 1, 1  # zeros are no rotation, and are not to be divided by
    state[:, 3:7] /= length[:, None]
    weight[:, 3:7] /= length[:, None, None].astype(np.float32)
    effect[3:7] *= length**2
    state[:, COLOUR] = state[:, COLOUR] @ _OPPONENT.T
    effect[COLOUR] = effect[COLOUR].mean(0)
    if channels == CHANNELS_WITH_COLOUR:
        weight[:, COLOUR] = _OPPONENT.astype(np.float32) @ weight[:, COLOUR]

    power = np.stack([_power(effect[group]) for group in (PLACE, SHAPE, COLOUR)], axis=1)
    scale = np.exp2(power)[:, GROUP_OF]
    root = np.maximum(np.sqrt(effect.sum(1) / (scale**2).sum(0)), LEAST_EFFECT)
    motion, pattern = _patterns(weight, values, scale)
    share = np.clip(seen.double().numpy(), 0, 1)[order]
    return Prepared(state, motion, pattern, power, root, share, deformation)


def round_to(prepared: Prepared, step: float) -> Compact:
    """Every number as a multiple of its step.

    Args:
        step: change of the picture, 1 from black to white, by one step of a mean Gaussian's number in all Gaussians.

    Raises:
        ValueError: numbers would need more digits than are stored, or there are more than MOST_NUMBERS.
    """
    channels, count, patterns = prepared.motion.shape
    columns = STATE + channels * patterns + 4
    _check_size(count, columns)
    steps = step / prepared.effect
    steps[3:7] = np.minimum(steps[3:7], COARSEST_ROTATION)
    table: NDArray[np.int32] = np.empty((count, columns), np.int32)

    def put(first: int, numbers: NDArray[np.floating]) -> None:
        largest = max(-float(numbers.min(initial=0)), float(numbers.max(initial=0)))
        if not largest <= LARGEST_STORED:
            raise ValueError(f"a step of {step:g} makes numbers as large as {largest:g}")
        table[:, first : first + numbers.shape[1]] = np.rint(numbers, out=numbers)

    units = np.exp2(prepared.power)[:, GROUP_OF] / steps  # [N, STATE]
    put(0, prepared.state * units)
    for channel, motion in enumerate(prepared.motion):
        put(STATE + channel * patterns, motion * units[:, channel, None].astype(np.float32))
    table[:, -4:-1] = prepared.power
    put(columns - 1, prepared.seen[:, None] * SEEN_LEVELS)
    pattern = np.ascontiguousarray(prepared.pattern * steps[:channels, None, None], np.float32)
    basis = prepared.basis
    return Compact(table, steps.astype(np.float32), pattern, basis.centre, basis.width)


def read(tensors: Mapping[str, Tensor]) -> Compact:
    """What Compact.tensors gave.

    Raises:
        ValueError: tensors are missing, do not fit together, or unpack to more than MOST_NUMBERS.
    """
    count, step, pattern, centre, width, shared = (
        _checked(tensors, name, kind, dimensions)
        for name, kind, dimensions in (
            ("count", torch.int64, 1),
            ("step", torch.float32, 1),
            ("pattern", torch.float32, 3),
            ("centre", torch.float32, 1),
            ("width", torch.float32, 1),
            ("shared", torch.uint8, 1),
        )
    )
    codes = [_checked(tensors, f"code.{part}", torch.uint8, 1).numpy().tobytes() for part in range(PARTS)]
    channels, patterns, bases = pattern.shape
    columns = STATE + channels * patterns + 4
    if count.shape != (1,) or step.shape != (STATE,) or shared.shape != (columns,):
        raise ValueError(f"count, step and shared do not fit {channels} channels of {patterns} patterns")
    if patterns != bases - 1 or channels not in (CHANNELS, CHANNELS_WITH_COLOUR):
        raise ValueError(f"{patterns} patterns in {channels} channels do not fit {bases} bases")
    rows = int(count[0])
    _check_size(rows, columns)
    table: NDArray[np.int32] = np.empty((rows, columns), np.int32)
    table[told_order(rows)] = decode(codes, rows, columns)
    _undo_differences(table, shared.numpy().astype(bool), pattern.shape)
    _check_numbers(table, step.numpy())
    return Compact(table, step.numpy(), pattern.numpy(), centre, width)


def compile_coder() -> float:
    """Compile what packs and unpacks for this processor, or load it from the cache; returns seconds."""
    start = time.perf_counter()
    table = np.ones((2, STATE + 4), np.int32)
    still = np.zeros((CHANNELS, 0, 1), np.float32)
    read(Compact(table, np.ones(STATE, np.float32), still, torch.zeros(1), torch.ones(1)).tensors())
    return time.perf_counter() - start


def _checked(tensors: Mapping[str, Tensor], name: str, kind: torch.dtype, dimensions: int) -> Tensor:
    if name not in tensors or tensors[name].dtype != kind or tensors[name].ndim != dimensions:
        raise ValueError(f"{name} is missing or of another type or shape")
    return tensors[name]


def _check_size(rows: int, columns: int) -> None:
    if rows < 1 or rows * columns > MOST_NUMBERS:
        raise ValueError(f"{rows} Gaussians of {columns} numbers are not kept so; at most {MOST_NUMBERS} numbers are")


def _check_numbers(table: NDArray[np.int32], step: Floats) -> None:
    if table.max() > LARGEST_STORED or table.min() < -LARGEST_STORED:
        raise ValueError(f"a number exceeds {LARGEST_STORED}")
    if not (step > 0).all() or not table[:, 3:7].any(axis=1).all():
        raise ValueError("a step or a quaternion is 0")


def _undo_differences(table: NDArray[np.int32], shared: NDArray[np.bool_], shape: Sequence[int]) -> None:
    """Differences to numbers, in place; the powers first, as the others hang on them.

    Raises:
        ValueError: a number, a power or a share lies outside its range.
    """
    group = _group(shape)
    add_differences(table, np.zeros((len(table), PLAIN + 1), np.int64), group, shared & (group == PLAIN))
    power, seen = table[:, -4:-1], table[:, -1]
    if power.min() < COARSEST or power.max() > FINEST or seen.min() < 0 or seen.max() > SEEN_LEVELS:
        raise ValueError("a power or a share lies outside its range")
    add_differences(table, _powers(table), group, shared & (group != PLAIN))


def _group(shape: Sequence[int]) -> Whole:
    """[K] which power belongs to each column of the table; shape [C, R, B]."""
    channels, patterns, _ = shape
    return np.concatenate([GROUP_OF, np.repeat(GROUP_OF[:channels], patterns), np.full(4, PLAIN)])


def _powers(table: NDArray[np.int32]) -> Whole:
    """[N, 4] of place, shape and colour, and 0 for the plain columns."""
    powers = table[:, -4:].astype(np.int64)
    powers[:, PLAIN] = 0
    return powers


def _gaussians_of(state: Floats) -> Gaussians:
    """Gaussians of their numbers at rest [N, STATE]."""
    held = torch.from_numpy(state)
    return Gaussians(
        mean=held[:, PLACE].contiguous(),
        quaternion=held[:, 3:7].contiguous(),
        log_scale=held[:, 7:10].contiguous(),
        opacity_logit=held[:, OPACITY].contiguous(),
        sh=held[:, None, COLOUR].contiguous(),
    )


def _state_of(gaussians: Gaussians) -> Reals:
    columns = [
        gaussians.mean,
        gaussians.quaternion,
        gaussians.log_scale,
        gaussians.sh[:, 0],
        gaussians.opacity_logit[:, None],
    ]
    state: Reals = torch.cat(columns, 1).double().numpy()
    return state


def _power(effect: Reals) -> Whole:
    """[N] powers of two nearest to each Gaussian's root mean effect over that of all; effect [channels, N]."""
    mean = effect.mean(1, keepdims=True)
    relative = np.mean(effect / np.where(mean > 0, mean, 1), axis=0)
    nearest = np.rint(np.log2(np.maximum(relative, 1e-12)) / 2)
    power: Whole = np.clip(nearest, COARSEST, FINEST).astype(np.int64)
    return power


def _patterns(weight: NDArray[np.float32], values: Reals, scale: Reals) -> tuple[NDArray[np.float32], Reals]:
    """Coefficients [C, N, R] and patterns [C, R, B] of weights [N, C, B] whose mean over the times is 0.

    values [T, B] of the bases at the trained times; scale [N, C or more], precision of each Gaussian's channel.
    """
    bases = values.shape[1]
    strength = values.T @ values / len(values)
    strength += RIDGE * np.trace(strength) / bases * np.eye(bases)
    root = np.linalg.cholesky(strength)  # errors of equal size after it weigh the same over the trained times
    coefficients = np.empty((weight.shape[1], len(weight), bases - 1), np.float32)
    patterns = np.empty((weight.shape[1], bases - 1, bases))
    for channel in range(weight.shape[1]):
        seen = weight[:, channel] @ root.astype(np.float32)
        scaled = seen * scale[:, channel, None].astype(np.float32)
        _, components = np.linalg.eigh((scaled.T @ scaled).astype(np.float64))
        kept = components[:, :0:-1]  # the weakest is nothing: the mean over time has been taken out
        coefficients[channel] = seen @ kept.astype(np.float32)
        patterns[channel] = np.linalg.solve(root.T, kept).T
    return coefficients, patterns


def _along_curve(mean: Reals) -> Whole:
    """[N] places along a Hilbert curve through the view from the world's origin, by convention the first frame's;
    mean [N, 3] in units."""
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
