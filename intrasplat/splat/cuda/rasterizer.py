"""The buffers of one image size and number of frames, and the calls of project, bin, blend and their gradients.

    rasterizer = CudaRasterizer(width, height, device, frames)
    rasterizer.project_and_sort(camera, state, opacity_logit, colour)
    image = rasterizer.render()
    gradients = rasterizer.loss_backward(rgb, weight, inverse_depth, loss_settings, frame)

Symbols: N Gaussians, F frames, M slots (bins.py), H W pixels, T frames of a clip. Arrays are contiguous tensors on the
device, float32 unless stated otherwise.

Once the buffers exist, nothing here reads from the device or allocates, except for the scratch of torch.sort. So all of
it can be captured in a CUDA graph. The buffers have space for ``capacity`` slots. A projection that needs more sets ok
to 0 and draws only what fits; until reset(), ok stays 0 and needed is the maximum needed. A kernel that changes
parameters reads ok on the device and does nothing if it is 0. The host reads it with grown().
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from intrasplat.splat.cuda.bins import EXTENT, FILL_BLOCK, MAX_FRAMES, SLOT, TILE_HEIGHT, TILE_WIDTH, fill_slots
from intrasplat.splat.cuda.blend import CHUNK, COTANGENT, LOSS, RENDER, STATISTICS, WARPS, blend
from intrasplat.splat.cuda.project import PROJECT_BLOCK, RECORD, project
from intrasplat.splat.cuda.project_backward import (
    BACKWARD_BLOCK,
    LANES,
    POSE_SHARE,
    SPLATS_BLOCK,
    SUM_WARPS,
    SUMS,
    project_backward,
    sum_slots,
)
from intrasplat.splat.layout import CAMERA, CHANNELS

_FIRST_GUESS = 8
"""Initial slots per Gaussian and frame; few, because sorting empty ones takes as long. At least one per tile, for a few
Gaussians that cover the image."""
_SPARE = 1.25
"""Capacity over the slots needed, so that a scene that grows slowly seldom needs more."""
_MAX_NUMBERS = 2**31 - 1
"""Kernels index the floats of records and slots with 32 bits."""


Numbers = torch.dtype | tuple[torch.dtype, ...]


def _check(tensor: Tensor, name: str, shape: tuple[int | None, ...], dtype: Numbers = torch.float32) -> None:
    """Raise ValueError unless shape, type and layout are right, because kernels only get an address; None: any size."""
    fits = len(tensor.shape) == len(shape) and all(b in (None, a) for a, b in zip(tensor.shape, shape, strict=True))
    types = dtype if isinstance(dtype, tuple) else (dtype,)
    if not fits or tensor.dtype not in types or not tensor.is_contiguous():
        kind = "contiguous" if tensor.is_contiguous() else "strided"
        wanted = " or ".join(map(str, types))
        raise ValueError(f"{name} is {kind} {tensor.dtype} {list(tensor.shape)}, not contiguous {wanted} {list(shape)}")


@dataclass(frozen=True, eq=False)
class Gradients:
    """dL/d of every frame's deformed state and colour, and of the opacity logit; |dL/dmean2d|. Live buffers."""

    state: Tensor  # [F, 10, N]
    opacity_logit: Tensor  # [F, N]
    colour: Tensor  # [F, 3, N]
    mean2d_norm: Tensor  # [F, N], in normalised device coordinates
    pose: Tensor  # float64 [programs, F, 12], to be summed over programs; empty unless asked for


class CudaRasterizer:
    """Buffers for one image size and F frames; they grow with the scene. Not thread-safe.

    Public for reading: ``count`` int32 [F, N], the tiles that each Gaussian touches in each frame (0: out of view);
    ``statistics`` [F, tiles, 4], the sums of loss_backward: colour L1, depth L1, squared colour error, 1 - A, over
    tissue; ``ok`` and ``needed`` int32 [1]; ``capacity``.

    Raises:
        ValueError: no image, or more frames than MAX_FRAMES.
    """

    def __init__(self, width: int, height: int, device: str | torch.device, frames: int = 1) -> None:
        if min(width, height) < 1:
            raise ValueError(f"no image of {width} x {height}")
        if not 1 <= frames <= MAX_FRAMES:
            raise ValueError(f"{frames} frames at once; these kernels sort 1 to {MAX_FRAMES}")
        self.width, self.height, self.frames, self.device = width, height, frames, torch.device(device)
        self.tiles_x, self.tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
        self.tiles = self.tiles_x * self.tiles_y
        self.gaussians, self.capacity = -1, 0
        everywhere = frames * self.tiles
        self._key_type = torch.int16 if everywhere < 2**15 else torch.int32
        self.ok, self.needed = self._integers(1), self._integers(1)
        self.statistics = self._floats(frames, self.tiles, STATISTICS)
        self._borders = torch.arange(everywhere + 1, dtype=self._key_type, device=self.device)
        self._tile_start = self._integers(everywhere + 1)
        self._image = self._floats(frames, 6, height, width)
        self._nothing = self._floats(1)
        self.reset()
        self.reserve(0, 1)

    def _floats(self, *shape: int) -> Tensor:
        return torch.zeros(shape, dtype=torch.float32, device=self.device)

    def _integers(self, *shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=self.device)

    def reserve(self, gaussians: int, capacity: int | None = None) -> None:
        """Allocate for N Gaussians and at least `capacity` slots; buffers that are large enough stay.

        Raises:
            ValueError: more floats than 32 bits can index.
        """
        if gaussians != self.gaussians:
            self._allocate_splats(gaussians)
        guess = self.frames * max(_FIRST_GUESS * gaussians, self.tiles)
        wanted = max(guess if capacity is None else capacity, 1)
        if self.capacity < wanted:
            self._allocate_slots(wanted)

    def _allocate_splats(self, gaussians: int) -> None:
        frames, splats = self.frames, self.frames * gaussians
        if splats * max(RECORD, SUMS) > _MAX_NUMBERS:
            raise ValueError(f"{gaussians} Gaussians in {frames} frames; these kernels number {_MAX_NUMBERS} floats")
        self.gaussians = gaussians
        self.count = self._integers(frames, gaussians)
        self._records = self._floats(splats, RECORD)
        self._extent = self._floats(splats, EXTENT)
        self._depth_key, self._sorted_depth = self._integers(splats), self._integers(splats)
        self._order, self._ends = (self._integers(splats, dtype=torch.int64) for _ in range(2))
        self._ordered_count, self._slot_start = self._integers(splats), self._integers(splats)
        self._sums = self._floats(SUMS, splats)
        self._programs = -(-gaussians // BACKWARD_BLOCK)
        self.gradients = Gradients(
            self._floats(frames, CHANNELS, gaussians),
            self._floats(frames, gaussians),
            self._floats(frames, 3, gaussians),
            self._floats(frames, gaussians),
            self._integers(self._programs, frames, POSE_SHARE, dtype=torch.float64),
        )

    def _allocate_slots(self, capacity: int) -> None:
        if capacity * SLOT > _MAX_NUMBERS:
            raise ValueError(f"{capacity} tiles touched at once; these kernels number {_MAX_NUMBERS} floats")
        self.capacity = capacity
        self._key, self._sorted_key = (self._integers(capacity, dtype=self._key_type) for _ in range(2))
        self._owner, self._sorted_owner = self._integers(capacity), self._integers(capacity)
        self._sorted_slot = self._integers(capacity, dtype=torch.int64)
        self._slots = self._floats(capacity, SLOT)
        chunks = capacity // CHUNK + self.frames * self.tiles
        self._before = self._floats(chunks, TILE_WIDTH * TILE_HEIGHT)

    def reset(self) -> None:
        """Forget earlier overflows: ok is 1, needed 0."""
        self.ok.fill_(1)
        self.needed.zero_()

    def grown(self) -> bool:
        """Wait; whether a projection since reset() exceeded the capacity. If so, the capacity is now enough."""
        if int(self.ok) == 1:
            return False
        self._allocate_slots(int(int(self.needed) * _SPARE) + 1)
        self.reset()
        return True

    def project_and_sort(self, camera: Tensor, state: Tensor, opacity_logit: Tensor, colour: Tensor) -> None:
        """Project onto every frame's camera, and list the splats of each tile, nearest first.

        camera: float64 [F, CAMERA], rows as camera_vector gives; state [F, 10 or more, N]; opacity_logit [N];
        colour [F, 3, N].

        Raises:
            ValueError: a tensor has another shape or type, or there are more slots than 32 bits can number.
        """
        gaussians = state.shape[-1]
        _check(camera, "camera", (self.frames, CAMERA), torch.float64)
        _check(state, "state", (self.frames, None, gaussians))
        _check(opacity_logit, "opacity_logit", (gaussians,))
        _check(colour, "colour", (self.frames, 3, gaussians))
        self.reserve(gaussians, 0 if gaussians == self.gaussians else None)
        self._camera, self._state, self._opacity_logit = camera, state, opacity_logit
        if gaussians == 0:
            self._tile_start.zero_()
            return
        project[(triton.cdiv(gaussians, PROJECT_BLOCK), self.frames)](
            camera, state, opacity_logit, colour, self._records.view(torch.int64), self._extent.view(torch.int64),
            self.count, self._depth_key,
            gaussians, state.shape[1], self.width, self.height, self.tiles_x, self.tiles_y,
            TILE_W=TILE_WIDTH, TILE_H=TILE_HEIGHT, BLOCK=PROJECT_BLOCK,
        )  # fmt: skip
        self._bin()

    def _bin(self) -> None:
        """Fill the slots in depth order, then sort them by tile."""
        splats, no_tile = self.frames * self.gaussians, self.frames * self.tiles
        torch.sort(self._depth_key, stable=True, out=(self._sorted_depth, self._order))
        torch.index_select(self.count.view(-1), 0, self._order, out=self._ordered_count)
        torch.cumsum(self._ordered_count, 0, out=self._ends)
        fill_slots[(triton.cdiv(self.capacity, FILL_BLOCK),)](
            self._ends, self._order, self.count, self._extent, self._key, self._owner, self._slot_start,
            self.needed, self.ok,
            self.capacity, splats, self.gaussians, self.width, self.height, self.tiles_x, self.tiles_y, no_tile,
            1 << (splats.bit_length() - 1), TILE_W=TILE_WIDTH, TILE_H=TILE_HEIGHT, BLOCK=FILL_BLOCK,
        )  # fmt: skip
        torch.sort(self._key, stable=True, out=(self._sorted_key, self._sorted_slot))
        torch.index_select(self._owner, 0, self._sorted_slot, out=self._sorted_owner)
        torch.searchsorted(self._sorted_key, self._borders, out_int32=True, out=self._tile_start)

    def _blend(
        self, mode: int, image: Tensor, values: bool, clip: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None = None
    ) -> None:
        """Launch the kernel in one of its modes. clip: rgb, weight, inverse depth, loss settings, frame."""
        rgb, weight, inverse_depth, settings, frame = clip or (self._nothing,) * 5
        blend[(self.frames * self.tiles,)](
            self._records.view(torch.int64), self._sorted_owner, self._sorted_slot, self._tile_start, self._before,
            image, self._slots, self.statistics, rgb, weight, inverse_depth, settings, frame,
            self.width, self.height, self.tiles_x, self.tiles,
            MODE=mode, VALUES=values, TILE_W=TILE_WIDTH, TILE_H=TILE_HEIGHT, K=CHUNK, num_warps=WARPS,
        )  # fmt: skip

    def render(self, values: Tensor | None = None) -> Tensor:
        """R G B Z A of the projected splats, [F, 5, H, W]: a buffer that the next render overwrites.

        With values [F, N] or [N], one per Gaussian, they are blended as colour is, and [F, 6, H, W] ends with them.
        """
        planes = 5 if values is None else 6
        if values is not None:
            self._records.view(self.frames, self.gaussians, RECORD)[:, :, 6] = values
        image = self._image.view(-1)[: self.frames * planes * self.height * self.width]
        self._blend(RENDER, image, values is not None)
        return image.view(self.frames, planes, self.height, self.width)

    def loss_backward(
        self,
        rgb: Tensor,
        weight: Tensor,
        inverse_depth: Tensor,
        loss_settings: Tensor,
        frame: Tensor,
        *,
        pose: bool = False,
    ) -> Gradients:
        """Gradients of the built-in loss (blend.py) against frames of a clip; statistics holds its sums per tile.

        rgb uint8 [T, 3, H, W], weight uint8 [T, H, W] (255 = tissue), inverse_depth float16 or float32 [T, H, W]
        (1 / units, 0 = none), loss_settings [F, 5], frame int32 [F]: which of the T each frame is.

        Raises:
            ValueError: a tensor has another shape or type.
        """
        size = (self.height, self.width)
        _check(rgb, "rgb", (None, 3, *size), torch.uint8)
        _check(weight, "weight", (len(rgb), *size), torch.uint8)
        _check(inverse_depth, "inverse_depth", (len(rgb), *size), (torch.float32, torch.float16))
        _check(loss_settings, "loss_settings", (self.frames, 5))
        _check(frame, "frame", (self.frames,), torch.int32)
        self._blend(LOSS, self._nothing, False, (rgb, weight, inverse_depth, loss_settings, frame))
        return self._project_backward(pose)

    def cotangent_backward(self, cotangents: Tensor, *, pose: bool = False) -> Gradients:
        """Gradients of sum(cotangents * image), cotangents [F, 5, H, W].

        Raises:
            ValueError: a tensor has another shape or type.
        """
        _check(cotangents, "cotangents", (self.frames, 5, self.height, self.width))
        self._blend(COTANGENT, cotangents, False)
        return self._project_backward(pose)

    def _project_backward(self, pose: bool) -> Gradients:
        """Gradients of the Gaussians' parameters from those of the slots, which blend has written."""
        out, splats = self.gradients, self.frames * self.gaussians
        if splats == 0:
            return out
        sum_slots[(triton.cdiv(splats, SPLATS_BLOCK),)](
            self._slots.view(torch.int64), self._key, self._slot_start, self.count, self._records, self._sums,
            self.capacity, splats, self.frames * self.tiles, RECORD=RECORD, BLOCK=SPLATS_BLOCK, LANES=LANES,
            num_warps=SUM_WARPS,
        )  # fmt: skip
        project_backward[(self._programs, self.frames)](
            self._camera, self._state, self._opacity_logit, self.count, self._sums,
            out.state, out.opacity_logit, out.colour, out.mean2d_norm, out.pose,
            self.gaussians, self._state.shape[1], splats, WITH_POSE=pose, BLOCK=BACKWARD_BLOCK,
        )  # fmt: skip
        return out
