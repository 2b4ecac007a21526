"""Finds eyes that are out of step, and the frames of the right eye that belong to the left one's.

A point lies on the same row of both rectified eyes, so the means of rows change alike in both at the same moment, and
hardly alike a frame later, whatever the disparity.

Symbols: T frames, k lag in frames: left frame t and right frame t + k show one moment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import RgbFrame
from intrasplat.machine.mapped import let_go
from intrasplat.notices import Notice, NoticeCode

ROWS, COLUMNS = 128, 160
"""A picture is reduced to so many rows, by means, and about so many columns, which are a part of its own."""
SMOOTH_ROWS = 8.0
"""Slower changes down the rows are shading, which light changes in both eyes at other moments."""
MAX_LAG = 8
MIN_ALIKE = 0.5
"""Correlation of what belongs together: 0.8 to 0.9 on three clips; a frame apart it is 0.25 at most."""
MIN_GAIN = 3.0
"""Sum of correlations over the frames that a lag must gain: about that of four frames."""
MIN_FRAMES = 4
"""A shorter part of a clip shows no lag."""

Profile = NDArray[np.float32]
"""[2 ROWS]"""


@dataclass(frozen=True)
class Lag:
    """Lag `before` up to left frame `at`, lag `after` from there on."""

    before: int
    after: int
    at: int

    def sources(self, frame_count: int) -> list[int | None]:
        """The right frame of each left frame; None: it has none, or it is not sure which."""
        found: list[int | None] = []
        for t in range(frame_count):
            k = self.before if t < self.at else self.after
            is_sure = self.before == self.after or abs(t - self.at) > 1
            found.append(t + k if is_sure and 0 <= t + k < frame_count else None)
        return found

    def notice(self, unpaired: Sequence[int]) -> Notice:
        """The warning about what was done."""
        k = self.after or self.before
        where = "throughout" if self.before == self.after else f"{'from' if self.after else 'up to'} frame {self.at}"
        late = "late" if k > 0 else "early"
        by = f"{abs(k)} frame" + ("" if abs(k) == 1 else "s")
        text = f"the right eye was out of step by {by} ({late}) {where}; it was moved to match, and"
        names = ", ".join(map(str, unpaired))
        return Notice.warning(NoticeCode.EYES_OUT_OF_STEP, f"{text} frames without a partner were left out ({names})")


def row_profile(rgb: RgbFrame) -> Profile:
    """Row means of a picture [H, W, 3], of its green levels and of its vertical detail, without slow changes."""
    green = np.ascontiguousarray(rgb[:, :: max(1, rgb.shape[1] // COLUMNS), 1])
    rows = cv2.resize(green, (green.shape[1], ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    means = np.stack([rows.mean(1), np.abs(np.diff(rows, axis=0, append=rows[-1:])).mean(1)], axis=1)
    fast = means - cv2.GaussianBlur(means, (1, 0), sigmaX=1e-3, sigmaY=SMOOTH_ROWS)
    return np.asarray(fast / (fast.std(0) + 1e-6), np.float32).ravel()


def find_lag(left: Sequence[Profile], right: Sequence[Profile]) -> Lag | None:
    """The lag of the right eye by the profiles of T frames; None: the eyes are in step, or nothing tells.

    The lag may change once, as when a recorder loses frames. One of the two lags is then 0.
    """
    count = len(left)
    if count < 2 * MIN_FRAMES:
        return None
    alike = _alike(np.diff(np.stack(left), axis=0), np.diff(np.stack(right), axis=0))
    sums = np.concatenate([np.zeros((1, alike.shape[1])), np.cumsum(alike, axis=0)])  # [T, lags]
    constant = {k: float(sums[-1, k + MAX_LAG]) for k in range(-MAX_LAG, MAX_LAG + 1)}
    k = max(constant, key=constant.__getitem__)
    is_out = constant[k] / (count - 1) >= MIN_ALIKE and constant[k] - constant[0] > MIN_GAIN
    best, least = (Lag(k, k, 0), constant[k] + MIN_GAIN) if is_out else (None, constant[0] + MIN_GAIN)
    for lag in _changes_once(count):
        parts = sums[lag.at, lag.before + MAX_LAG], sums[-1, lag.after + MAX_LAG] - sums[lag.at, lag.after + MAX_LAG]
        means = parts[0] / lag.at, parts[1] / (count - 1 - lag.at)
        if min(means) >= MIN_ALIKE and sum(parts) > least:
            best, least = lag, sum(parts)
    return best


def _changes_once(count: int) -> Iterator[Lag]:
    """All lags that are 0 before or after some frame and not 0 on its other side."""
    for at in range(MIN_FRAMES, count - MIN_FRAMES):
        for k in (k for k in range(-MAX_LAG, MAX_LAG + 1) if k != 0):
            yield from (Lag(0, k, at), Lag(k, 0, at))


def _alike(left: NDArray[np.float32], right: NDArray[np.float32]) -> NDArray[np.float64]:
    """Correlation [T - 1, 2 MAX_LAG + 1] of the changes of left frame t and of right frame t + k; 0 beyond the clip."""
    left, right = (each / (np.linalg.norm(each, axis=1, keepdims=True) + 1e-6) for each in (left, right))
    every = left @ right.T
    before = {k: min(max(0, -k), len(every)) for k in range(-MAX_LAG, MAX_LAG + 1)}
    return np.stack([np.pad(np.diagonal(every, k), (before[k], before[-k])) for k in before], 1)


def move_frames(frames: NDArray[np.uint8], sources: Sequence[int | None]) -> None:
    """Frame t [T, H, W, 3] becomes that of sources[t], in place. All moves go in one direction."""
    moves = [(t, source) for t, source in enumerate(sources) if source is not None and source != t]
    for t, source in moves if all(source > t for t, source in moves) else moves[::-1]:
        frames[t] = frames[source]
        let_go(frames[t])
        let_go(frames[source])
