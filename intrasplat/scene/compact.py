"""The compact form of a scene: a table of integers, which the range coder packs, and its way back to Gaussians.

Symbols: N Gaussians, C channels (10, 13 with colour, 14 with gloss), B bases, R < B patterns of motion per channel,
K columns.

A decoder undoes four steps (intrasplat/scene/quantize.py does them): motion is coefficients of patterns, numbers are
multiples of a step, columns may be differences between neighbours, and the table is range coded. docs/scene-file.md
describes the file for other readers.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.scene.differences import MAX_POWER, MAX_STORED, add_differences, coding_order, take_differences
from intrasplat.scene.rangecoder import PARTS, decode, encode
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import (
    CHANNELS,
    COLOUR,
    COLOUR_CHANNELS,
    GLOSS_ROW,
    LOG_SCALE,
    MEAN,
    OPACITY_ROW,
    QUATERNION,
    ROWS,
    VALUES,
)

Whole = NDArray[np.int64]
Floats = NDArray[np.float32]

GROUP_OF = np.array([0] * 3 + [1] * 7 + [2] * 5)
"""Index of the power of each number of the state: 0 position, 1 shape, 2 colour."""
PLAIN = 3
"""Group of the last columns, the powers and `seen`, whose step is 1."""
PLAIN_COLUMNS = 4
MIN_POWER = -3
"""Smallest power of two by which a Gaussian's precision may differ from the mean; MAX_POWER is the largest. Other views
may show what the trained frames hardly show, so its precision is at least an eighth of the mean."""
SEEN_LEVELS = 63
ROWS_AT_ONCE = 1 << 14
"""Gaussians whose coefficients are converted to floats at once."""
MAX_NUMBERS = 7 * 2**25
"""Numbers that a scene may have: those of 170 thousand Gaussians and 97 bases. Unpacking takes up to 14 bytes a number
with one basis, and 10 with many. So no file, however small, takes more than 3.1 GiB plus its motion's weights."""
MAX_WEIGHTS = 7 * 2**25
"""Weights that a motion may have: 0.9 GiB, so that finishing a clip of 1,000 frames takes 3 GiB. A long clip has more
bases than patterns."""
OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Orthonormal colour axes: brightness, red - blue, magenta - green."""


TENSORS = {
    "count": (torch.int64, 1),
    "step": (torch.float32, 1),
    "pattern": (torch.float32, 3),
    "centre": (torch.float32, 1),
    "width": (torch.float32, 1),
    "shared": (torch.uint8, 1),
}
"""Type and dimensions of a file's tensors by name. The file's other tensors are the PARTS codes of the table."""


class DoesNotFitError(ValueError):
    """A scene needs more or larger integers than the compact form allows."""


def state_rows(channels: int) -> list[int]:
    """Rows of intrasplat/splat/layout.py that a table stores of a Gaussian at rest, if its motion has `channels`
    channels.

    If no channel is for the gloss, the table has no gloss.
    """
    return [row for row in range(VALUES) if row != GLOSS_ROW or channels == ROWS]


@dataclass(frozen=True, eq=False)
class Numbers(ABC):
    """A scene in integers: a table in memory, or numbers that are computed when they are needed.

    step     [S] float32      step of each number of the state at power 0; S = 15, or 14 without a channel for the gloss
    pattern  [C, R, B] float32  weights of one unit of a motion coefficient at power 0
    centre, width  [B] float32  centre and width of each basis
    """

    step: NDArray[np.float32]
    pattern: NDArray[np.float32]
    centre: Tensor
    width: Tensor

    @abstractmethod
    def at_rest(self) -> NDArray[np.int32]:
        """[N, S] the state."""

    @abstractmethod
    def coefficients(self, first: int, last: int) -> NDArray[np.int32]:
        """[N, (last - first) R] motion coefficients of the channels from first up to last."""

    @abstractmethod
    def powers(self) -> NDArray[np.integer]:
        """[N, 3] powers of position, shape and colour."""

    def at(self, times: Sequence[float]) -> Iterator[Floats]:
        """The Gaussians' numbers at each model time, [VALUES, N], rows as in intrasplat/splat/layout.py. They equal
        those of model()'s deformation, but its large weights are not computed."""
        bases = SharedBasis(torch.zeros(0, CHANNELS, len(self.centre)), self.centre, self.width)
        values = np.stack([bases.basis(t).numpy() for t in times], 1)  # [B, times]
        state, motion = self._state().T, self._motion(self.pattern @ values).T  # [VALUES, N], [times, C, N]
        for moved in motion:
            numbers = state.copy(order="C")
            numbers[: len(moved)] += moved
            yield numbers

    def _scale(self, group: int) -> Floats:
        """[N] 2**-power in a group."""
        return np.exp2(-self.powers()[:, group].astype(np.float32))  # exact

    def _state(self) -> Floats:
        """[N, VALUES] numbers at rest, colour as red, green and blue."""
        scales, numbers = [self._scale(group) for group in range(PLAIN)], self.at_rest()
        state = np.zeros((len(numbers), VALUES), np.float32)
        for column, row in enumerate(state_rows(self.pattern.shape[0])):
            state[:, row] = numbers[:, column] * (scales[GROUP_OF[row]] * self.step[column])
        state[:, COLOUR] = state[:, COLOUR] @ OPPONENT.astype(np.float32)
        return state

    def _motion(self, pattern: Floats) -> Floats:
        """[N, C, X] motion coefficients times patterns [C, R, X], with colour as red, green and blue."""
        channels, patterns, columns = pattern.shape
        motion = np.empty((len(self.powers()), channels, columns), np.float32)

        def fill(first: int, last: int, weights: Floats) -> None:
            """Fill the channels from first up to last: their coefficients times weights [(last - first) R,
            (last - first) X]. Few rows at a time: floats of all rows would take as much memory as the motion."""
            whole, scale = self.coefficients(first, last), self._scale(GROUP_OF[first])[:, None]
            for start in range(0, len(whole), ROWS_AT_ONCE):
                some = slice(start, start + ROWS_AT_ONCE)
                block = whole[some].astype(np.float32)
                block *= scale[some]
                motion[some, first:last] = (block @ weights).reshape(-1, last - first, columns)

        for channel in range(CHANNELS):
            fill(channel, channel + 1, pattern[channel])
        if channels > CHANNELS:
            mixing = np.einsum("or,opx->oprx", OPPONENT.astype(np.float32), pattern[COLOUR])
            fill(CHANNELS, COLOUR_CHANNELS, mixing.reshape(3 * patterns, 3 * columns))
        if channels > COLOUR_CHANNELS:
            fill(GLOSS_ROW, ROWS, pattern[GLOSS_ROW])
        return motion


@dataclass(frozen=True, eq=False)
class Compact(Numbers):
    """A scene in integers, in one table.

    table    [N, K] int32     columns: the state, then R motion coefficients per channel, then the 3 powers, then `seen`
    """

    table: NDArray[np.int32]

    def at_rest(self) -> NDArray[np.int32]:
        return self.table[:, : len(self.step)]

    def coefficients(self, first: int, last: int) -> NDArray[np.int32]:
        patterns = self.pattern.shape[1]
        return self.table[:, len(self.step) + first * patterns : len(self.step) + last * patterns]

    def powers(self) -> NDArray[np.int32]:
        return self.table[:, -4:-1]

    def model(self) -> tuple[Gaussians, SharedBasis, Tensor]:
        """Gaussians, motion and `seen` [N], as floats."""
        weight = torch.from_numpy(self._motion(self.pattern))
        share = torch.from_numpy(self.table[:, -1].astype(np.float32) / np.float32(SEEN_LEVELS))
        return _gaussians_of(self._state()), SharedBasis(weight, self.centre, self.width), share

    def tensors(self) -> dict[str, Tensor]:
        """The tensors of scene.safetensors: the coded table, with differences where they help; the rest as it is."""
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


def unpack(tensors: Mapping[str, Tensor]) -> Compact:
    """The compact scene from the tensors that Compact.tensors() returned.

    Raises:
        ValueError: tensors are missing, do not fit together, or unpack to more than MAX_NUMBERS numbers.
    """
    count, step, pattern, centre, width, shared = (
        _checked(tensors, name, kind, dimensions) for name, (kind, dimensions) in TENSORS.items()
    )
    codes = [_checked(tensors, f"code.{part}", torch.uint8, 1).numpy().tobytes() for part in range(PARTS)]
    if len(tensors) > len(TENSORS) + PARTS:
        raise ValueError("there are tensors that no compact scene has")
    channels, patterns, bases = pattern.shape
    at_rest = len(state_rows(channels))
    columns = at_rest + channels * patterns + PLAIN_COLUMNS
    if count.shape != (1,) or step.shape != (at_rest,) or shared.shape != (columns,):
        raise ValueError(f"count, step and shared do not fit {channels} channels of {patterns} patterns")
    if not patterns < bases == len(centre) == len(width) or channels not in (CHANNELS, COLOUR_CHANNELS, ROWS):
        raise ValueError(f"{patterns} patterns in {channels} channels do not fit {bases} bases")
    rows = int(count[0])
    check_size(rows, columns)
    if rows * channels * bases > MAX_WEIGHTS:
        raise ValueError(
            f"{rows} Gaussians of {channels} channels of {bases} bases are more than {MAX_WEIGHTS} weights"
        )
    table: NDArray[np.int32] = np.empty((rows, columns), np.int32)
    table[coding_order(rows)] = decode(codes, rows, columns)
    _undo_differences(table, shared.numpy().astype(bool), pattern.shape)
    _check_numbers(table, step.numpy())
    return Compact(step.numpy(), pattern.numpy(), centre, width, table)


def compile_coder() -> float:
    """Compile the coder's kernels for this processor, or load them from the cache; return the seconds it took."""
    start = time.perf_counter()
    table = np.ones((2, VALUES + 4), np.int32)
    still = np.zeros((ROWS, 0, 1), np.float32)
    unpack(Compact(np.ones(VALUES, np.float32), still, torch.zeros(1), torch.ones(1), table).tensors())
    return time.perf_counter() - start


def _checked(tensors: Mapping[str, Tensor], name: str, kind: torch.dtype, dimensions: int) -> Tensor:
    if name not in tensors or tensors[name].dtype != kind or tensors[name].ndim != dimensions:
        raise ValueError(f"{name} is missing or of another type or shape")
    return tensors[name]


def check_size(rows: int, columns: int) -> None:
    """Check the size of a table.

    Raises:
        DoesNotFitError: the table is empty or has more than MAX_NUMBERS numbers.
    """
    if rows < 1 or rows * columns > MAX_NUMBERS:
        raise DoesNotFitError(
            f"{rows} Gaussians of {columns} numbers: a table has 1 Gaussian at least, and at most {MAX_NUMBERS} numbers"
        )


def _check_numbers(table: NDArray[np.int32], step: Floats) -> None:
    if table.max() > MAX_STORED or table.min() < -MAX_STORED:
        raise ValueError(f"a number exceeds {MAX_STORED}")
    if not (step > 0).all() or not table[:, QUATERNION].any(axis=1).all():
        raise ValueError("a step or a quaternion is 0")


def _undo_differences(table: NDArray[np.int32], shared: NDArray[np.bool_], shape: Sequence[int]) -> None:
    """Turn differences back into numbers, in place. The powers come first, because the other columns need them.

    Raises:
        ValueError: a number, a power or a `seen` lies outside its range.
    """
    group = _group(shape)
    add_differences(table, np.zeros((len(table), PLAIN + 1), np.int64), group, shared & (group == PLAIN))
    power, seen = table[:, -4:-1], table[:, -1]
    if power.min() < MIN_POWER or power.max() > MAX_POWER or seen.min() < 0 or seen.max() > SEEN_LEVELS:
        raise ValueError("a power or a share lies outside its range")
    add_differences(table, _powers(table), group, shared & (group != PLAIN))


def _group(shape: Sequence[int]) -> Whole:
    """[K] index of the power of each column of the table; shape: [C, R, B]."""
    channels, patterns, _ = shape
    at_rest = GROUP_OF[state_rows(channels)]
    return np.concatenate([at_rest, np.repeat(GROUP_OF[:channels], patterns), np.full(PLAIN_COLUMNS, PLAIN)])


def _powers(table: NDArray[np.int32]) -> Whole:
    """[N, 4] powers of position, shape and colour, and 0 for the plain columns."""
    powers = table[:, -4:].astype(np.int64)
    powers[:, PLAIN] = 0
    return powers


def _gaussians_of(state: Floats) -> Gaussians:
    """The Gaussians whose numbers at rest are state [N, VALUES]."""
    values = torch.from_numpy(state)
    return Gaussians(
        mean=values[:, MEAN].contiguous(),
        quaternion=values[:, QUATERNION].contiguous(),
        log_scale=values[:, LOG_SCALE].contiguous(),
        opacity_logit=values[:, OPACITY_ROW].contiguous(),
        sh=values[:, None, COLOUR].contiguous(),
        gloss=values[:, GLOSS_ROW].contiguous(),
    )
