"""Motion known before training: optical flow from the first training frame, lifted to 3D by stereo depth.

Dense flow (DIS) from the reference to every training frame gives each reference pixel a track. Forward and backward
flow check each other. A track's displacements and changes of colour are averages of its trusted neighbours, over a
wider area where few are trusted (docs/decisions/024). fit_tracks fits the bases of a motion to them. Held-out frames
are never read.

Symbols: K training frames, h w pixels of the coarse grid on which flow is computed, N points, B bases.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock, Semaphore
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from worker.input.camera import unproject
from worker.input.clip import DepthClip
from worker.machine.cores import cores
from worker.machine.mapped import let_go, mapped_zeros
from worker.machine.opencv import one_opencv_thread
from worker.motion.complete import complete_depth
from worker.motion.least_squares import fit_series

Floats = NDArray[np.float32]
Moved = Callable[[int, NDArray[np.intp]], Floats]
"""Displacements [M, 3] mm (world) of what the first training frame's pixels (flat, [M]) show, to a training frame."""

FLOW_WIDTH = 320
"""Maximum width in px at which flow is computed: the clip is reduced by the smallest whole factor that fits."""
MIN_GRID_SIDE = 16
"""Minimum cells along the coarse grid's shorter side, which DIS needs; a smaller clip is not reduced."""
ROUND_TRIP_PX = 1.0
"""A difference of this much between forward and backward flow, in px of the coarse grid, halves the confidence."""
SMOOTH_PX = 4.0
"""Standard deviation of the Gaussian mean of displacements, in px of the coarse grid: depth is noisy."""
COLOUR_SMOOTH_PX = 2.0
"""The same for changes of colour: light varies over smaller patches than motion does."""
SURROUNDINGS = 0.1
"""Weight of the wider surroundings' mean in an average; full trust has 1."""
LOST, LOST_SMOOTH_PX = 0.1, 1.0
"""A track of less confidence ends on the surface that surrounds it; px of the coarse grid over which that eases in."""
MIN_DEPTH_MM = 1e-3
GUESSED = 0.02
"""Minimum confidence of a track when a motion starts from it: the surroundings' displacement is better than none."""
CHAINS = 2
"""Parts of the clip that are tracked in parallel. It does not depend on the number of cores, because each flow starts
from the one before."""
POINTS_AT_ONCE, FRAMES_AT_ONCE = 4096, 128
"""Points that are fitted together in a clip of so many frames; in a longer one fewer, for their tracks take memory."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Displacement of reference pixels to every training frame, and how their colour changed on the way.

    displacement_mm [K, h, w, 3]  world axes, mm; mean of the trusted neighbours, 0 without any; a lost one ends on
                                  the frame's surface
    colour          [K, h, w, 3]  colour there minus colour in the reference, RGB in [0, 1]; mean likewise
    confidence      [K, h, w]     in [0, 1]; 0 where the track is lost, hidden or without depth
    step_px                       clip pixels between neighbouring cells of the grid
    """

    displacement_mm: Floats
    colour: Floats
    confidence: Floats
    step_px: int

    @classmethod
    def empty(cls, frames: int, grid: tuple[int, ...], step_px: int) -> Tracks:
        """Tracks of zeros, in files (worker/machine/mapped.py)."""
        displacement_mm, colour = (mapped_zeros((frames, *grid, 3), np.float32) for _ in range(2))
        return cls(displacement_mm, colour, mapped_zeros((frames, *grid), np.float32), step_px)

    def let_go(self, place: int) -> None:
        """Take a frame's part out of memory. It comes back when it is asked for."""
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
    threads: int | None = None,
) -> Tracks:
    """Tracks of the first training frame's tissue through the others. They do not depend on `threads` (None: cores).

    on_progress gets the share of frames done. Threads of this function call it, one at a time. What it raises ends the
    tracking and is raised here.
    """
    step = min(-(-clip.intrinsics.width // FLOW_WIDTH), max(1, min(clip.tissue.shape[1:]) // MIN_GRID_SIDE))
    grid = _Grid(clip, step)
    reference = _Coarse(clip, train[0], grid)
    tracks = Tracks.empty(len(train), reference.grey.shape, step)
    tracks.confidence[0] = reference.trust
    followed, counting = 0, Lock()

    def lift(place: int, target: _Coarse, forward: Floats, backward: Floats) -> None:
        nonlocal followed
        found = _lift(reference, target, forward, backward)
        tracks.displacement_mm[place], tracks.colour[place], tracks.confidence[place] = found
        tracks.let_go(place)
        with counting:
            followed += 1
            on_progress(followed / (len(train) - 1))

    def follow(places: Sequence[int]) -> None:
        flow_solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        forward: Floats | None = None
        for place in places:  # in order of time: the last flow starts the next
            target = _Coarse(clip, train[place], grid)
            forward = flow_solver.calc(reference.grey, target.grey, None if forward is None else forward.copy())
            backward = flow_solver.calc(target.grey, reference.grey, -forward)
            helped.run(lift, place, target, forward, backward)

    threads = cores() if threads is None else threads
    length = -(-len(train) // CHAINS)
    chains = [range(max(first, 1), min(first + length, len(train))) for first in range(0, len(train), length)]
    with one_opencv_thread(), ThreadPoolExecutor(min(CHAINS, threads)) as pool, _Helpers(threads - CHAINS) as helped:
        list(pool.map(follow, chains))
    return tracks


class _Helpers:
    """Free threads that lift flows to 3D for the threads that compute them: lifting takes longer."""

    def __init__(self, count: int) -> None:
        self._free = Semaphore(max(count, 0))
        self._pool = ThreadPoolExecutor(max(count, 1))
        self._jobs: deque[Future[None]] = deque()

    def run(self, work: Callable[..., None], *arguments: Any) -> None:
        """Run work(*arguments) in a helper, or here if all are busy. Raises what earlier work raised."""
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


def cell_means(image: NDArray[Any], step: int) -> NDArray[Any]:
    """[h, w, ...] means of the cells of step by step pixels. Cell (i, j) starts at pixel (step i, step j).

    Pixels beyond the last whole cell are ignored.
    """
    h, w = image.shape[0] // step, image.shape[1] // step
    means: NDArray[Any] = cv2.resize(image[: h * step, : w * step], (w, h), interpolation=cv2.INTER_AREA)
    return means


class _Grid:
    """The coarse grid: the pixels that it samples and their rays. h w cells, step pixels apart."""

    def __init__(self, clip: DepthClip, step: int) -> None:
        height, width = clip.tissue.shape[1:]
        self.step, self.size = step, (width // step, height // step)
        rows, columns = np.mgrid[0 : self.size[1], 0 : self.size[0]] * step + step // 2
        pixels = (rows * width + columns).ravel()
        rays = unproject(pixels, np.ones(pixels.size, np.float32), clip.intrinsics, np.eye(4))
        self.rays = rays.reshape(*rows.shape, 3).astype(np.float32)
        """[h, w, 3] points at depth 1, camera axes."""

    def cells_at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Column and row in the grid, not rounded, of what lies at (x, y) at depth 1, camera axes."""
        height, width = self.rays.shape[:2]
        (left, top, _), (right, bottom, _) = self.rays[0, 0], self.rays[-1, -1]
        return (x - left) * ((width - 1) / (right - left)), (y - top) * ((height - 1) / (bottom - top))

    def sample(self, values: NDArray[Any]) -> NDArray[Any]:
        """[h, w] the cells' middle pixels of an image; a view."""
        return values[self.step // 2 :: self.step, self.step // 2 :: self.step][: self.size[1], : self.size[0]]


class _Coarse:
    """A frame on the coarse grid: colour, grey, depth, points (world, mm), and the confidence of depth and mask.

    Where no tissue is measured, depth is completed from around; it is 0 in a frame without any.
    """

    def __init__(self, clip: DepthClip, index: int, grid: _Grid) -> None:
        self.grey = cell_means(cv2.cvtColor(clip.rgb[index], cv2.COLOR_RGB2GRAY), grid.step)
        self.rgb = np.asarray(cell_means(clip.rgb[index], grid.step) / np.float32(255), np.float32)
        depth_mm = grid.sample(clip.depth_mm[index])
        usable = grid.sample(clip.tissue[index]) & (depth_mm > 0)
        pose = clip.world_from_camera[index].astype(np.float32)
        self.grid, self.axes, self.place_mm = grid, pose[:3, :3], pose[:3, 3]
        self.depth_mm = complete_depth(depth_mm, usable, np.ones_like(usable))
        self.points_mm: Floats = (grid.rays * self.depth_mm[..., None]) @ self.axes.T + self.place_mm
        confidence = grid.sample(clip.depth_confidence[index]) / np.float32(255)
        self.trust = np.where(usable, confidence, np.float32(0))
        clip.let_go(index)


def _lift(reference: _Coarse, target: _Coarse, forward: Floats, backward: Floats) -> tuple[Floats, Floats, Floats]:
    """Displacement (mm), change of colour and confidence of every reference cell, from the flows there and back."""
    rows, columns = np.mgrid[0 : forward.shape[0], 0 : forward.shape[1]].astype(np.float32)
    x, y = columns + forward[..., 0], rows + forward[..., 1]

    def at_target(values: Floats) -> Floats:
        moved: Floats = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return moved

    round_trip = forward + at_target(backward)
    trust = at_target(target.trust)
    agree = 1 / (1 + (np.square(round_trip).sum(-1) / ROUND_TRIP_PX**2) ** 2)
    confidence = reference.trust * trust * (trust > 0.5) * agree
    point_mm = at_target(target.points_mm * target.trust[..., None]) / np.maximum(trust, 1e-3)[..., None]
    displacement = _averaged(np.subtract(point_mm, reference.points_mm), confidence, SMOOTH_PX)
    if target.depth_mm.any():  # else nobody knows its surface
        displacement = _onto_surface(reference, target, displacement, confidence)
    colour = _averaged(np.subtract(at_target(target.rgb), reference.rgb), confidence, COLOUR_SMOOTH_PX)
    return displacement, colour, np.minimum(confidence, 1).astype(np.float32)


def _onto_surface(reference: _Coarse, target: _Coarse, displacement: Floats, confidence: Floats) -> Floats:
    """The displacement [h, w, 3] with the ends of lost tracks on target's surface, along the line of sight.

    What hides stays on the surface around it: a displacement that is guessed from farther away, where tissue may be
    pulled towards the camera, would lift it into free space.
    """
    end_mm = (reference.points_mm + displacement - target.place_mm) @ target.axes
    z = np.maximum(end_mm[..., 2], MIN_DEPTH_MM)
    x, y = target.grid.cells_at(end_mm[..., 0] / z, end_mm[..., 1] / z)
    surface_mm = cv2.remap(target.depth_mm, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lost = cv2.GaussianBlur((confidence < LOST).astype(np.float32), (0, 0), LOST_SMOOTH_PX)
    along_mm = end_mm * (lost * (surface_mm / z - 1))[..., None]
    return np.asarray(displacement + along_mm @ target.axes.T, np.float32)


def _averaged(values: Floats, confidence: Floats, over_px: float) -> Floats:
    """Normalised convolution: Gaussian mean [h, w, 3] weighted by confidence.

    Where no neighbour is trusted, wider surroundings fill in.
    """
    weight = np.asarray(cv2.GaussianBlur(confidence, (0, 0), over_px), np.float32)
    return _completed(cv2.GaussianBlur(values * confidence[..., None], (0, 0), over_px), weight)


def _completed(total: Floats, weight: Floats) -> Floats:
    """total [h, w, 3] / weight [h, w]; the result on a grid half as fine counts as one more observation (pull-push)."""
    height, width = weight.shape
    if min(height, width) < 2:
        return np.broadcast_to(total.sum((0, 1)) / max(float(weight.sum()), 1e-9), total.shape).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    coarse = _completed(*(np.asarray(cv2.resize(x, half, interpolation=cv2.INTER_AREA)) for x in (total, weight)))
    wider = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((total + SURROUNDINGS * wider) / (weight + SURROUNDINGS)[..., None], np.float32)


def moved_along(tracks: Tracks, train: Sequence[int], width: int) -> Moved:
    """The tracks as a function for fusion. train lists the clip's frames that they cover; width is the clip's in px."""
    place_of = {index: place for place, index in enumerate(train)}

    def moved(index: int, pixels: NDArray[np.intp]) -> Floats:
        found: Floats = tracks.displacement_mm[place_of[index]][tracks.cells(*np.divmod(pixels, width))]
        return found

    return moved


def resting(tracks: Tracks, clip: DepthClip, train: Sequence[int]) -> Tracks:
    """The tracks if nothing had moved: no displacement, and the change of colour in place.

    The confidence is the tracks' where a cell shows only tissue, else 0.
    """
    (frames, *grid), step = tracks.confidence.shape, tracks.step_px
    rest = Tracks.empty(frames, tuple(grid), step)
    start = cell_means(clip.rgb[train[0]], step).astype(np.float32)

    def look(place: int) -> None:
        index = train[place]
        tissue = cell_means(clip.tissue[index].astype(np.uint8) * np.uint8(255), step) == 255
        rest.confidence[place] = np.where(tissue, tracks.confidence[place], 0)
        change = (cell_means(clip.rgb[index], step) - start) / np.float32(255)
        rest.colour[place] = _averaged(change, rest.confidence[place], COLOUR_SMOOTH_PX)
        for used in (rest, tracks):
            used.let_go(place)
        clip.let_go(index)

    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(look, range(len(train))))
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
        basis: [K, B] value of every basis at every training time.
        pixels: [N] flat pixel indices (row * width + column) of the points in the reference frame.
        width: of the clip, px.
        share_px: points in the same square of this many pixels share the weights of its first pixel.
        guessed: minimum confidence g_k in the frame of the highest mean confidence; in the other frames g_k is smaller
            in proportion to their mean confidence. A displacement guessed from the surroundings is better than none.

    Returns:
        weights [N, B, 6]: 3 of the displacement in mm, 3 of the colour; and support [N]: mean confidence of each track.
    """
    rows, columns = (place // share_px * share_px for place in np.divmod(pixels, width))
    shared, member = np.unique(rows * width + columns, return_inverse=True)
    row, column = tracks.cells(*np.divmod(shared, width))
    cells = row * tracks.confidence.shape[2] + column
    weights = np.zeros((len(shared), basis.shape[1], 6), np.float32)
    support = np.zeros(len(shared), np.float32)

    trust = tracks.confidence.mean((1, 2))
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
