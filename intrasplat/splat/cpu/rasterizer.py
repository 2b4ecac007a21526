"""The buffers of one image size, and the calls of the kernels: project, bin, blend and their gradients.

N Gaussians (a multiple of LANES, see padded), M slots, H W pixels. All arrays are NumPy, rows of N (project.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.splat.cpu import bins, project
from intrasplat.splat.cpu.blend import COTANGENT, LOSS, PLANE, PLANES, RECORD, RENDER, STATISTICS, blend
from intrasplat.splat.cpu.threads import run, thread_count
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.layout import ROWS
from intrasplat.splat.step import Target

Floats = NDArray[np.float32]
_NO_LOSS = np.zeros(5, np.float32)


def _aligned(rows: int, columns: int) -> Floats:
    """Zeros whose rows are aligned to cache lines if columns is a multiple of 16, so that no vector straddles two."""
    raw = np.zeros(rows * columns + 16, np.float32)
    start = -(raw.ctypes.data // 4) % 16
    return raw[start : start + rows * columns].reshape(rows, columns)


def padded(count: int) -> int:
    """The next multiple of LANES: rows of N are processed LANES at a time."""
    return -(-count // LANES) * LANES


@dataclass
class Gradients:
    """dL/d of every Gaussian's deformed state, opacity logit and colour, and of camera_from_world; |dL/dmean2d|.

    With several frames per step, colour and pose are those of the last frame, the others those of all frames.
    """

    state: Floats  # [ROWS, N]; COLOUR and GLOSS are the caller's to fill
    opacity_logit: Floats  # [N]
    colour: Floats  # [3, N]
    mean2d_norm: Floats  # [N], in normalised device coordinates
    pose: NDArray[np.float64]  # [threads, 12], to be summed

    @classmethod
    def zeros(cls, state: Floats) -> Gradients:
        """Gradients of zeros for N Gaussians that use `state` [ROWS, N] as their array of the state."""
        count = state.shape[1]
        logit, norm = np.zeros((2, count), np.float32)
        return cls(state, logit, np.zeros((3, count), np.float32), norm, np.zeros((thread_count(), 12)))


class Rasterizer:
    """Buffers for one image size; they grow with the scene and are reused from step to step. Not thread-safe."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height, self.threads = width, height, thread_count()
        self.tiles_x, self.tiles_y = -(-width // LANES), -(-height // bins.TILE_ROWS)
        self.tiles = self.tiles_x * self.tiles_y
        self.stride = self.tiles_x * LANES
        self.image = np.zeros(6 * height * self.stride, np.float32)
        self.statistics = np.zeros((self.tiles, STATISTICS), np.float32)
        self._planes = _aligned(self.threads, PLANES * PLANE)
        self._tape, self._records = _aligned(self.threads, 0), _aligned(self.threads, 0)
        self._spans = np.zeros((self.threads, 0, 3), np.int32)
        self._tile_start = np.zeros(self.tiles + 1, np.int64)
        self._region_end = np.zeros((self.threads, 2), np.int64)
        self._next_block = np.zeros(1, np.int64)
        self._no_target = Target(np.zeros(1, np.uint8), np.zeros(1, np.uint8), np.zeros(1, np.float32))
        self._allocate_gaussians(0)
        self._allocate_slots(0, 0)

    def _allocate_gaussians(self, count: int) -> None:
        if count > bins.MAX_GAUSSIANS:
            raise ValueError(f"{count} Gaussians; these kernels number at most {bins.MAX_GAUSSIANS}")
        self.splats = np.zeros((count, project.SPLAT), np.float32)
        self.radius2 = np.full(count, -1.0, np.float32)
        self.slot_start = np.zeros(count, np.int32)
        self._slot_count = np.zeros(count, np.int32)
        self._extent = np.zeros((count, bins.EXTENT), np.float32)
        self._accumulators = np.zeros((count, 4), np.int32)
        self._order = np.zeros((2, count), np.int32)
        self._keys = np.zeros((2, count), np.uint32)
        self.gradients = Gradients.zeros(np.zeros((ROWS, count), np.float32))

    def _allocate_slots(self, slots: int, accumulators: int) -> None:
        """Allocate so many slots and accumulators per thread."""
        self._slot_info, self._entries = np.zeros((2, self.threads * slots), np.uint32)
        self._sums = np.zeros(self.threads * accumulators * bins.GRADIENT, np.float32)

    def project_and_sort(
        self, camera: NDArray[np.float64], state: Floats, opacity_logit: Floats, colour: Floats
    ) -> None:
        """Project and list each tile's splats. camera: camera_vector; state [>= 10, N], colour [3, N]."""
        self.project(camera, state, opacity_logit, colour)
        self.sort()

    def project(self, camera: NDArray[np.float64], state: Floats, opacity_logit: Floats, colour: Floats) -> None:
        """Compute the splats on the image; sort() follows."""
        count = state.shape[1]
        if self.splats.shape[0] != count:
            self._allocate_gaussians(count)
        self._camera, self._state, self._opacity_logit = camera, state, opacity_logit
        run(
            project.project, camera, state, opacity_logit, colour, self.splats.reshape(-1), self.radius2,
            self._extent.reshape(-1),
        )  # fmt: skip

    def sort(self) -> None:
        """After project: every splat's slots and accumulators, and every tile's entries, nearest first."""
        if not self._filled():
            self._allocate_slots(*(self._needed() * 5 // 4).tolist())
            self._filled()
        ranks, keys = self._order, self._keys
        count, is_first = bins.depth_order(self.splats, self.radius2, ranks[0], keys[0], ranks[1], keys[1])
        bins.sort_into_tiles(
            ranks[0 if is_first else 1], count, self.slot_start, self._slot_count, self._slot_info, self._region_end,
            self._tile_start, self._entries,
        )  # fmt: skip

    def _filled(self) -> bool:
        """Write the slots; False if a thread's region is too small for them."""
        run(
            bins.fill_slots, self.splats, self.radius2, self._extent, self.height, self.tiles_x,
            len(self._sums) // bins.GRADIENT, self.slot_start, self._slot_count, self._slot_info, self._accumulators,
            self._region_end,
        )  # fmt: skip
        return bool((self._needed() <= self._regions()).all())

    def _regions(self) -> NDArray[np.int64]:
        """Capacity of a thread's region: slots and accumulators."""
        return np.array([len(self._slot_info), len(self._sums) // bins.GRADIENT]) // self.threads

    def _needed(self) -> NDArray[np.int64]:
        """The most slots, and the most accumulators, that a thread needs."""
        return np.asarray((self._region_end - self._regions() * np.arange(self.threads)[:, None]).max(0))

    def _reserve(self) -> None:
        """Allocate a thread's scratch for the fullest tile; pages that are never written take no memory."""
        most = int(np.diff(self._tile_start).max()) * bins.TILE_ROWS
        if self._spans.shape[1] < most:
            most = most * 5 // 4
            self._spans = np.zeros((self.threads, most, 3), np.int32)
            self._records = _aligned(self.threads, most * RECORD)
            self._tape = _aligned(self.threads, most * 2 * LANES)

    def _clear_accumulators(self) -> None:
        """Set the accumulators to 0."""
        _, region = self._regions()
        for thread, (_, end) in enumerate(self._region_end):
            self._sums[thread * region * bins.GRADIENT : end * bins.GRADIENT] = 0

    def blend(
        self, mode: int, target: Target, loss_settings: Floats, image: Floats, bands: tuple[int, int] | None = None
    ) -> None:
        """Run the kernel in one of its modes (blend.py). bands: first and end of the rows of tiles; None: all."""
        self._reserve()
        if mode != RENDER:
            self._clear_accumulators()
        first, end = bands or (0, self.tiles_y)
        self._next_block[0] = first * -(-self.tiles_x // bins.BLOCK_TILES)
        run(
            blend, self._next_block, mode, self.width, self.height, self.tiles_x, self.splats,
            self._tile_start[: end * self.tiles_x + 1], self._entries, self._accumulators, self._records, self._spans,
            self._tape, self._planes, self._sums, self.statistics, target.rgb, target.weight, target.inverse_depth,
            loss_settings, image,
        )  # fmt: skip

    def render(self, values: Floats | None = None) -> Floats:
        """R G B Z A of the projected splats, [5, H, W]; a view of a buffer the next render overwrites.

        With values [<= N], a number per Gaussian, they are blended as colour is, and [6, H, W] ends with them.
        """
        if values is not None:
            self.set_values(values)
        return self.render_rows(0, self.tiles_y)[: 5 if values is None else 6]

    def set_values(self, values: Floats) -> None:
        """Blend values [<= N], a number per Gaussian, beside colour until the next projection."""
        self.splats[: len(values), 11] = values

    def render_rows(self, first: int, end: int) -> Floats:
        """Rows of tiles [first, end) of the projected splats: R G B Z A and the values that are set, [6, h, W].

        A view of these rows of a buffer, bit-identical to those of a render of all rows.
        """
        self.blend(RENDER, self._no_target, _NO_LOSS, self.image, (first, end))
        rows = slice(first * bins.TILE_ROWS, min(end * bins.TILE_ROWS, self.height))
        return self.image.reshape(6, self.height, self.stride)[:, rows, : self.width]

    def loss_backward(
        self,
        target: Target,
        loss_settings: Floats,
        out: Gradients | None = None,
        *,
        adds: bool = False,
        adds_state: bool = False,
    ) -> Gradients:
        """Gradients of the built-in loss (blend.py, _loss) against target; statistics holds its sums per tile.

        out: where they are written; None: a buffer that the next call overwrites. adds, adds_state: whether to add to
        out instead, as project_backward of project.py describes.
        """
        self.blend(LOSS, target, loss_settings, self.image)
        return self.project_backward(out, adds=adds, adds_state=adds_state)

    def cotangent_backward(self, cotangents: Floats) -> Gradients:
        """Gradients of sum(cotangents * image), cotangents [5, H, W]."""
        padded_cotangents = np.zeros((5, self.height, self.stride), np.float32)
        padded_cotangents[:, :, : self.width] = cotangents
        self.blend(COTANGENT, self._no_target, _NO_LOSS, padded_cotangents.ravel())
        return self.project_backward()

    def project_backward(
        self, out: Gradients | None = None, *, adds: bool = False, adds_state: bool = False
    ) -> Gradients:
        """Gradients of the Gaussians' parameters from those in the accumulators, which blend has summed."""
        out = out or self.gradients
        run(
            project.project_backward, self._camera, self._state, self._opacity_logit, self.radius2,
            self._accumulators, self._sums, adds, adds_state,
            out.state, out.opacity_logit, out.colour, out.mean2d_norm, out.pose,
        )  # fmt: skip
        return out
