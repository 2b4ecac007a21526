"""The two kinds of clip: StereoClip as recorded, DepthClip with depth; and Eye, one eye of a clip with depth.

Symbols of the whole library: T frames, H W pixels (rows, columns), N Gaussians, B bases, C = 10 deformed channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.recorded_masks import Rectification
from intrasplat.machine.mapped import let_go
from intrasplat.notices import Notice
from intrasplat.report import CameraPoses, FieldOfView, Masks, RightEye

PIXELS = ("rgb", "tissue", "depth_mm", "depth_confidence")
"""Names of an eye's arrays [T, H, W, ...]. They may be mapped from files (intrasplat/machine/mapped.py)."""

RgbFrame = NDArray[np.uint8]  # [H, W, 3]


class PairSource(Protocol):
    """Left and right frames, decoded on demand. Each call starts again from frame 0."""

    def __call__(self) -> Iterator[tuple[RgbFrame, RgbFrame]]: ...


@dataclass(frozen=True)
class StereoClip:
    """A stereo clip as recorded, not yet rectified. Frames are decoded lazily, RGB uint8.

    tissue is [T, H, W] bool (True = tissue) in the pixels of the recorded left eye, or None without masks.
    tissue_right is the same for the right eye, or None if the masks show the left eye alone.
    frame_times_s is [T] float64, from the container, or i / 30 if it has none.
    damaged lists frames with a damaged picture or mask, rising. No stage reads them.
    pixel_aspect is width / height of a pixel by the container.
    given_fields are the fields of view that the caller gave, [H, W] bool as recorded: none, the left eye's, or both.
    """

    frame_count: int
    height: int
    width: int
    pairs: PairSource
    tissue: NDArray[np.bool_] | None
    frame_times_s: NDArray[np.float64]
    assumptions: tuple[Notice, ...] = ()
    warnings: tuple[Notice, ...] = ()
    tissue_right: NDArray[np.bool_] | None = None
    damaged: tuple[int, ...] = ()
    pixel_aspect: float = 1.0
    given_fields: tuple[NDArray[np.bool_], ...] = ()


@dataclass(frozen=True)
class Eye:
    """The frames of one rectified eye with metric depth, tissue mask and camera.

    rgb              [T, H, W, 3] uint8
    tissue           [T, H, W]    bool, True = tissue (tools, labels and borders are False)
    depth_mm         [T, H, W]    float32, camera z in mm, 0 = invalid
    depth_confidence [T, H, W]    uint8, 255 = left-right consistent and textured, 0 where depth is invalid
    world_from_camera [T, 4, 4]   float64, mm, OpenCV axes; the world is the left camera of frame 0
    field_of_view    [H, W]       bool, False where no frame shows the scene, nor has tissue; None: the whole picture
    """

    rgb: NDArray[np.uint8]
    tissue: NDArray[np.bool_]
    depth_mm: NDArray[np.float32]
    depth_confidence: NDArray[np.uint8]
    intrinsics: Intrinsics
    world_from_camera: NDArray[np.float64]
    field_of_view: NDArray[np.bool_] | None = field(default=None, kw_only=True)

    @property
    def frame_count(self) -> int:
        return int(self.rgb.shape[0])

    @property
    def field_pixels(self) -> int:
        """The pixels in the field of view."""
        return self.tissue[0].size if self.field_of_view is None else int(np.count_nonzero(self.field_of_view))

    @property
    def t(self) -> NDArray[np.float64]:
        """Model time of each frame, t_i = i / T, in [0, 1)."""
        return np.arange(self.frame_count) / self.frame_count

    def let_go(self, index: int) -> None:
        """Release a frame's pixels from memory if they are mapped from files. Access reads them back."""
        for name in PIXELS:
            let_go(getattr(self, name)[index])

    def one_by_one(self, frames: Iterable[int]) -> Iterator[int]:
        """The frames as given; each is released from memory when the next is requested."""
        for index in frames:
            yield index
            self.let_go(index)

    def arrays_at(self, frames: slice) -> dict[str, Any]:
        """The eye's arrays by name, for some frames alone, as views."""
        return {name: getattr(self, name)[frames] for name in (*PIXELS, "world_from_camera")}


@dataclass(frozen=True)
class DepthClip(Eye):
    """The left eye with its frame times, and the right eye if there is one. Training reads nothing else.

    frame_times_s    [T]          float64, seconds from frame 0
    right            the same times and size; None for a clip of one eye
    registration     corrections of the right eye's camera and colours; None for a clip of one eye
    masks            source of `tissue`
    fov              entry of the field of view for the report; None: it was not looked for, and field_of_view is as
                     the caller gave it
    rectification    rectification of the recorded left eye; None: it is as recorded
    poses            source of world_from_camera; None: poses are not set yet
    first_pose       [4, 4] of frame 0 in the layout's own world, mm, OpenCV axes; None: not known
    skipped         skipped frames (sampling.py): no stage reads them, and stereo gives them no depth
    """

    frame_times_s: NDArray[np.float64]
    right: Eye | None = None
    registration: RightEye | None = None
    masks: Masks | None = None
    fov: FieldOfView | None = None
    rectification: Rectification | None = None
    poses: CameraPoses | None = None
    first_pose: NDArray[np.float64] | None = None
    skipped: tuple[int, ...] = ()
    assumptions: tuple[Notice, ...] = ()
    warnings: tuple[Notice, ...] = ()
    measurements: dict[str, float] = field(default_factory=dict)  # e.g. vertical misalignment in px, for the report

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """The left eye, and the right one if there is one."""
        return (self,) if self.right is None else (self, self.right)

    @property
    def used(self) -> list[int]:
        """The frames that are not in skipped, in order."""
        return sorted(set(range(self.frame_count)) - set(self.skipped))

    @property
    def frame_s(self) -> float:
        """The median time in seconds from frame to frame."""
        return float(np.median(np.diff(self.frame_times_s)))

    def moment(self, index: int) -> DepthClip:
        """A clip of one frame of both eyes, with views of this clip's arrays."""
        only = slice(index, index + 1)
        right = None if self.right is None else replace(self.right, **self.right.arrays_at(only))
        return replace(self, right=right, frame_times_s=self.frame_times_s[only], skipped=(), **self.arrays_at(only))
