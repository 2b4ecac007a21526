"""The clean clip that every condition degrades, and the result of a condition: the clip as a user would give it.

Symbols: T frames of the clean clip, S frames of the given one, H W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip
from lab.conditions.recording import Recording
from lab.phantom import Phantom, PhantomSettings, make_phantom

REFERENCE_WIDTH = 640
"""Lengths in the table of conditions are pixels of a picture this wide, so that every size is degraded equally."""
SEEN_SHARE = 0.25
"""Minimum share of the frames in which a pixel must show tissue, for what the instrument hides there to be scored."""


@dataclass(frozen=True, eq=False)
class CleanClip:
    """A phantom's clip with its truth.

    clip     as recorded: with sensor noise, the instrument, and true depth
    rgb      [T, H, W, 3] float32 in [0, 1], the tissue without instrument and noise
    depth_mm [T, H, W] float32, its depth
    """

    phantom: Phantom
    clip: DepthClip
    rgb: NDArray[np.float32]
    depth_mm: NDArray[np.float32]

    @property
    def px(self) -> float:
        """Pixels of this clip in one of a picture REFERENCE_WIDTH wide."""
        return self.clip.intrinsics.width / REFERENCE_WIDTH

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[T, H, W] pixels that show tissue in at least SEEN_SHARE of the frames."""
        return np.asarray((self.clip.tissue.mean(axis=0) >= SEEN_SHARE) & (self.depth_mm > 0))


@dataclass(frozen=True, eq=False)
class Given:
    """A clip as the user would give it, with its true result.

    clip     decoded, or a recording that is to be written as files and read like any other
    rgb      [T, H, W, 3] float32 in [0, 1], what a model without flaw would show at the clean clip's frames
    depth_mm [T, H, W] float32, its depth
    scored   [T, H, W] bool, the pixels that are judged
    source   [S] the clean frame at the time of each given frame
    path     [T, 4, 4] mm, the camera's poses, if the user does not know them
    """

    clip: DepthClip | Recording
    rgb: NDArray[np.float32]
    depth_mm: NDArray[np.float32]
    scored: NDArray[np.bool_]
    source: tuple[int, ...]
    path: NDArray[np.float64] | None = None


def clean_clip(settings: PhantomSettings) -> CleanClip:
    """The clean clip of these settings."""
    return clean_of(make_phantom(settings))


def clean_of(phantom: Phantom) -> CleanClip:
    """The clean clip of a phantom."""
    clip = phantom.depth_clip()
    seen = [phantom.render(index) for index in range(clip.frame_count)]
    return CleanClip(phantom, clip, np.stack([rgb for rgb, _ in seen]), np.stack([depth for _, depth in seen]))


def given(clean: CleanClip, clip: DepthClip | Recording | None = None, **truth: NDArray[np.generic]) -> Given:
    """The clean clip, or `clip` in its place; judged where the clean clip shows tissue in SEEN_SHARE of its frames or
    more, and there also in frames in which the instrument hides it.

    truth: rgb, depth_mm or scored, where they differ from the clean clip's.
    """
    parts = {"rgb": clean.rgb, "depth_mm": clean.depth_mm, "scored": clean.seen, **truth}
    return Given(clip or clean.clip, source=tuple(range(clean.clip.frame_count)), **parts)  # type: ignore[arg-type]


def to_bytes(levels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Levels of 0 to 255, rounded, and clipped as a camera does."""
    return np.asarray(np.clip(np.rint(levels), 0, 255), dtype=np.uint8)
