"""Tracks of the tissue before training: optical flow from a keyframe, the reference, lifted to 3D by stereo depth.

Dense flow (DIS) from the reference to every training frame that sees enough of it gives each reference pixel a track.
Forward and backward flow check each other. A track's displacements and changes of colour are averages over its trusted
neighbours, over a wider area where few are trusted. fit_tracks fits the bases of a motion to them. Held-out frames are
never read.

Symbols: T training frames, K of them tracked; h w pixels of the coarse grid, on which flow runs; N points, B bases.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock, Semaphore
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.machine.cores import cores
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.motion.least_squares import fit_series
from intrasplat.motion.lifted import (
    COLOUR_SMOOTH_PX,
    CoarseFrame,
    Floats,
    Flows,
    PointGrid,
    averaged,
    cell_means,
    lifted,
)

Moved = Callable[[int, NDArray[np.intp]], Floats]
"""moved(frame, pixels): displacement [M, 3] mm (world) of a keyframe's pixels (flat, [M]) to a training frame."""

FLOW_WIDTH = 320
"""Maximum width in px at which flow is computed: the clip is reduced by the smallest whole factor that fits."""
MIN_GRID_SIDE = 16
"""Minimum cells along the coarse grid's shorter side, which DIS needs; a smaller clip is not reduced."""
GUESSED = 0.02
"""Minimum confidence of a track that initialises a motion: the surroundings' displacement is better than none."""
CHAINS = 2
"""Parts of the clip that are tracked in parallel. The number is fixed, because each flow initialises the next one."""
POINTS_AT_ONCE, FRAMES_AT_ONCE = 4096, 128
"""Points that are fitted together in a clip of FRAMES_AT_ONCE frames; fewer in a longer clip, to limit memory."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Displacement and change of colour of a reference frame's pixels in training frames.

    displacement_mm [K, h, w, 3]  world axes, mm; mean of the trusted neighbours, 0 without any; lost tracks end on
                                  the frame's surface
    colour          [K, h, w, 3]  colour there minus colour in the reference, RGB in [0, 1]; mean likewise
    confidence      [K, h, w]     in [0, 1]; 0 where the track is lost, hidden or without depth
    step_px                       clip pixels between neighbouring cells of the grid
    reference                     index of the reference among all training frames
    places                        [K] indices of the tracked frames, rising; None: all training frames are tracked
    """

    displacement_mm: Floats
    colour: Floats
    confidence: Floats
    step_px: int
    reference: int = 0
    places: Sequence[int] | None = None

    @classmethod
    def empty(cls, places: Sequence[int], grid: tuple[int, ...], step_px: int, reference: int = 0) -> Tracks:
        """Tracks filled with zeros, stored in files (intrasplat/machine/mapped.py)."""
        displacement_mm, colour = (mapped_zeros((len(places), *grid, 3), np.float32) for _ in range(2))
        confidence = mapped_zeros((len(places), *grid), np.float32)
        return cls(displacement_mm, colour, confidence, step_px, reference, places)

    @property
    def followed(self) -> NDArray[np.intp]:
        """Indices [K] of the tracked frames among all training frames."""
        return np.array(range(len(self.confidence)) if self.places is None else self.places, np.intp)

    def let_go(self, place: int) -> None:
        """Release a frame's part from memory. It is read back from its file on access."""
        for values in (self.displacement_mm, self.colour, self.confidence):
            let_go(values[place])

    def at(self, cells: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
        """Displacement and colour [K, M, 3] and confidence [K, M] of some cells (flat, [M])."""
        frames = len(self.confidence)
        displacement_mm, colour = np.empty((2, frames, len(cells), 3), np.float32)
        confidence = np.empty((frames, len(cells)), np.float32)
        for place in range(frames):
            displacement_mm[place] = self.displacement_mm[place].reshape(-1, 3)[cells]
            colour[place] = self.colour[place].reshape(-1, 3)[cells]
            confidence[place] = self.confidence[place].reshape(-1)[cells]
            self.let_go(place)
        return displacement_mm, colour, confidence

    def cells(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column in the coarse grid of the clip's pixels; beyond the grid's end, its last cells."""
        last_row, last_column = self.confidence.shape[1] - 1, self.confidence.shape[2] - 1
        return np.minimum(rows // self.step_px, last_row), np.minimum(columns // self.step_px, last_column)


def track(
    clip: DepthClip,
    train: Sequence[int],
    on_progress: Callable[[float], None] = lambda share: None,
    *,
    reference: int = 0,
    places: Sequence[int] | None = None,
    threads: int | None = None,
) -> Tracks:
    """Tracks of one training frame's tissue through the others. They do not depend on `threads` (None: cores).

    Args:
        reference: the index of that frame in train.
        places: indices of the frames to track, rising, including the reference; None: all.
        on_progress: gets the share of frames done. Threads of this function call it, one at a time. An exception that
            it raises ends the tracking and is raised here.
    """
    step = min(-(-clip.intrinsics.width // FLOW_WIDTH), max(1, min(clip.tissue.shape[1:]) // MIN_GRID_SIDE))
    grid = PointGrid(clip, step)
    start, places = CoarseFrame(clip, train[reference], grid), range(len(train)) if places is None else places
    tracks, own = Tracks.empty(places, start.grey.shape, step, reference), places.index(reference)
    tracks.confidence[own] = start.trust
    followed, counting = 0, Lock()

    def lift(row: int, target: CoarseFrame, forward: Floats, backward: Floats) -> None:
        nonlocal followed
        found = lifted(start, target, forward, backward)
        tracks.displacement_mm[row], tracks.colour[row], tracks.confidence[row] = found
        tracks.let_go(row)
        with counting:
            followed += 1
            on_progress(followed / (len(places) - 1))

    def follow(rows: Sequence[int]) -> None:
        flows = Flows(start)
        for row in rows:
            target = CoarseFrame(clip, train[places[row]], grid)
            forward, backward = flows.to(target)
            helped.run(lift, row, target, forward, backward)

    threads = cores() if threads is None else threads
    length = -(-len(places) // CHAINS)
    parts = (range(first, min(first + length, len(places))) for first in range(0, len(places), length))
    chains = [[row for row in part if row != own] for part in parts]
    with one_opencv_thread(), ThreadPoolExecutor(min(CHAINS, threads)) as pool, _Helpers(threads - CHAINS) as helped:
        list(pool.map(follow, chains))
    return tracks


class _Helpers:
    """Extra threads that lift flows to 3D for the threads that compute flow, because lifting takes longer."""

    def __init__(self, count: int) -> None:
        self._free = Semaphore(max(count, 0))
        self._pool = ThreadPoolExecutor(max(count, 1))
        self._jobs: deque[Future[None]] = deque()

    def run(self, work: Callable[..., None], *arguments: Any) -> None:
        """Run work(*arguments) in a helper thread, or here if all are busy. Raises exceptions of earlier work."""
        if not self._free.acquire(blocking=False):
            work(*arguments)
            return
        job = self._pool.submit(work, *arguments)
        job.add_done_callback(lambda _: self._free.release())
        self._jobs.append(job)
        if self._jobs[0].done():
            self._jobs.popleft().result()

    def __enter__(self) -> _Helpers:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown()
        for job in self._jobs if error is None else ():
            job.result()


def without_gains(tracks: Tracks, clip: DepthClip, train: Sequence[int], log_gains: NDArray[np.float64]) -> Tracks:
    """The tracks as if every picture of the clip had been divided by its gains: exp of log_gains [T of the clip, 3].

    Only the changes of colour are new.
    """
    gains = np.exp(-log_gains[list(train)]).astype(np.float32)
    start = np.asarray(cell_means(clip.rgb[train[tracks.reference]], tracks.step_px) / np.float32(255), np.float32)
    colour = mapped_zeros(tracks.colour.shape, np.float32)

    def recolour(row: int) -> None:
        there, here = gains[tracks.followed[row]], gains[tracks.reference]
        mean = averaged(start, tracks.confidence[row], COLOUR_SMOOTH_PX)
        colour[row] = tracks.colour[row] * there + mean * (there - here)
        let_go(colour[row])
        tracks.let_go(row)

    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(recolour, range(len(colour))))
    return replace(tracks, colour=colour)


def moved_along(tracks: Tracks, train: Sequence[int], width: int) -> Moved:
    """The tracks as a function for fusion. An untracked frame gets the displacement to the nearest tracked one.

    train lists the clip's training frames; width is the clip's in px.
    """
    followed = np.array(train)[tracks.followed]

    def moved(index: int, pixels: NDArray[np.intp]) -> Floats:
        row = int(np.abs(followed - index).argmin())
        found: Floats = tracks.displacement_mm[row][tracks.cells(*np.divmod(pixels, width))]
        return found

    return moved


def resting(tracks: Tracks, clip: DepthClip, train: Sequence[int]) -> Tracks:
    """Tracks under the hypothesis of rest: no displacement, and the change of colour at the same pixel.

    The confidence is that of `tracks` where a cell shows only tissue, else 0.
    """
    (frames, *grid), step = tracks.confidence.shape, tracks.step_px
    followed = tracks.followed
    rest = Tracks.empty(followed.tolist(), tuple(grid), step, tracks.reference)
    start = cell_means(clip.rgb[train[tracks.reference]], step).astype(np.float32)

    def look(place: int) -> None:
        index = train[followed[place]]
        tissue = cell_means(clip.tissue[index].astype(np.uint8) * np.uint8(255), step) == 255
        rest.confidence[place] = np.where(tissue, tracks.confidence[place], 0)
        change = (cell_means(clip.rgb[index], step) - start) / np.float32(255)
        rest.colour[place] = averaged(change, rest.confidence[place], COLOUR_SMOOTH_PX)
        for used in (rest, tracks):
            used.let_go(place)
        clip.let_go(index)

    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(look, range(frames)))
    return rest


def fit_tracks(
    tracks: Tracks,
    basis: NDArray[np.float64],
    pixels: NDArray[np.intp],
    width: int,
    *,
    share_px: int = 1,
    guessed: float = 0.0,
) -> tuple[Floats, Floats]:
    """Weights of the bases for points of the reference frame: weighted least squares over the training frames.

    Minimises sum_k max(c_k, g_k) |basis_k . w - d_k|^2 + STEADINESS sum_j |w_{j+1} - w_j|^2 + RIDGE |w|^2 for each
    point.

    Args:
        basis: [T, B] value of every basis at every training time.
        pixels: [N] flat pixel indices (row * width + column) of the points in the reference frame.
        width: of the clip, px.
        share_px: points in the same square with sides of share_px share the weights of its first pixel.
        guessed: minimum confidence g_k in the frame of the highest mean confidence; in the other frames g_k is smaller
            in proportion to their mean confidence. A displacement guessed from the surroundings is better than none.

    Returns:
        weights [N, B, 6]: 3 for the displacement in mm, 3 for the colour; support [N]: mean confidence of each track.
    """
    rows, columns = (place // share_px * share_px for place in np.divmod(pixels, width))
    shared, member = np.unique(rows * width + columns, return_inverse=True)
    row, column = tracks.cells(*np.divmod(shared, width))
    cells = row * tracks.confidence.shape[2] + column
    weights = np.zeros((len(shared), basis.shape[1], 6), np.float32)
    support = np.zeros(len(shared), np.float32)

    basis, trust = basis[tracks.followed], tracks.confidence.mean((1, 2))
    least = guessed * trust / max(float(trust.max()), 1e-9)
    at_once = max(1, POINTS_AT_ONCE * FRAMES_AT_ONCE // max(len(basis), FRAMES_AT_ONCE))

    def fit(first: int) -> None:
        some = slice(first, first + at_once)
        displacement_mm, colour, confidence = tracks.at(cells[some])
        changes = np.concatenate([displacement_mm, colour], axis=-1)
        weights[some] = fit_series(changes, np.maximum(confidence, least[:, None]), basis)
        support[some] = confidence.mean(0)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(fit, range(0, len(shared), at_once)))
    return weights[member], support[member]
