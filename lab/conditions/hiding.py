"""Instruments that hide tissue, and masks that do not fit them. Symbols: T frames, H W pixels.

Each function degrades a clean clip by `level`; `random` is seeded by the cell. Lengths in pixels refer to a picture 640
wide.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip
from lab.conditions.clean import CleanClip, Given, clean_clip, given
from lab.conditions.recording import recording_of
from lab.phantom import PhantomFrame
from lab.phantom.settings import Tool

STEEL = (118, 121, 124)
BRUSHED_LEVELS = 6  # standard deviation of the steel's grain, of 255
TOOL_DEPTH_MM = 45.0  # nearer than any tissue of the phantom
NO_MASKS: tuple[tuple[tuple[Tool, ...], float], ...] = (
    (("yellow",), 0.0),
    (("steel",), 0.0),
    (("dark",), 0.3),
    (("steel", "dark"), 0.6),
    (("grasper", "steel", "dark"), 0.9),
)
"""Instruments, and the share of the tissue's colour in theirs: increasingly hard to find."""
WAG_DEG, WAG_PERIODS = 12.0, 1.5  # a large instrument swings about its entry point


def tools_over_frame(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """A second, swinging instrument over `level` of the picture, with correct masks. Scored outside it."""
    clip = clean.clip
    frames, height, width = clip.tissue.shape
    start = random.uniform(0, 2 * np.pi)
    covered = np.stack([beyond(start + _wag(index, frames), level, height, width) for index in range(frames)])
    spoilt = with_instrument(clip, covered, STEEL, random)
    return given(clean, spoilt, scored=clean.seen & ~covered)


def hidden_at_start(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """A masked instrument hides a disc of `level` of the picture in frame 0 and shrinks to nothing by half-time.

    Scored also where it still hides the tissue: all of it is seen in the end.
    """
    frames, height, width = clean.clip.tissue.shape
    column, row = random.uniform(0.4, 0.6) * width, random.uniform(0.4, 0.6) * height
    away = np.hypot(*(np.indices((height, width)) - np.array([row, column])[:, None, None]))
    share_left = np.clip(1 - np.arange(frames) / max(frames / 2, 1), 0, 1)
    radius = np.quantile(away, level) * np.sqrt(share_left)
    covered = away[None] < radius[:, None, None]
    return given(clean, with_instrument(clean.clip, covered, STEEL, random))


def mask_shift(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Masks lie `level` px beside their instrument, in one direction for the whole clip."""
    angle = random.uniform(0, 2 * np.pi)
    shift = clean.px * level * np.array([np.cos(angle), np.sin(angle)])
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    size = clean.clip.tissue.shape[:0:-1]
    moved = [
        cv2.warpAffine(mask.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        for mask in clean.clip.tissue
    ]
    return given(clean, dataclasses.replace(clean.clip, tissue=np.stack(moved) > 0))


def masks_missing(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of the frames, drawn at random, have no mask: their instrument counts as tissue."""
    tissue = clean.clip.tissue.copy()
    tissue[random.permutation(len(tissue))[: round(level * len(tissue))]] = True
    return given(clean, dataclasses.replace(clean.clip, tissue=tissue))


def inverted_masks(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files whose masks have tissue and instrument exchanged, where instruments cover `level` of the picture."""
    frames, height, width = clean.clip.tissue.shape
    start = random.uniform(0, 2 * np.pi)
    covered = np.stack([beyond(start + _wag(index, frames), level, height, width) for index in range(frames)])

    def spoil(frame: PhantomFrame, index: int) -> PhantomFrame:
        steel = covered[index][..., None]
        left, right = (np.where(steel, np.array(STEEL, np.uint8), eye) for eye in (frame.left, frame.right))
        return dataclasses.replace(frame, left=left, right=right, tissue=~(frame.tissue & ~covered[index]))

    return given(clean, recording_of(clean.phantom, spoil), scored=clean.seen & ~covered)


def no_masks(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files without masks, with the instruments NO_MASKS[level - 1]."""
    del random
    tools, tint = NO_MASKS[round(level) - 1]
    drawn = clean_clip(dataclasses.replace(clean.phantom.settings, tools=tools))

    def spoil(frame: PhantomFrame, index: int) -> PhantomFrame:
        del index
        eyes = ((frame.left, frame.tissue), (frame.right, frame.tissue_right))
        left, right = (_tinted(eye, ~tissue, tint) for eye, tissue in eyes)
        return dataclasses.replace(frame, left=left, right=right)

    return given(drawn, recording_of(drawn.phantom, spoil, masks=False))


def _tinted(eye: NDArray[np.uint8], where: NDArray[np.bool_], tint: float) -> NDArray[np.uint8]:
    """The picture with `tint` of the tissue's mean colour where an instrument is."""
    if where.all() or not where.any():
        return eye
    tissue_rgb = eye[~where].mean(axis=0)
    return np.where(where[..., None], (1 - tint) * eye + tint * tissue_rgb + 0.5, eye).astype(np.uint8)


def _wag(index: int, frames: int) -> float:
    return float(np.deg2rad(WAG_DEG) * np.sin(2 * np.pi * WAG_PERIODS * index / frames))


def beyond(angle: float, share: float, height: int, width: int) -> NDArray[np.bool_]:
    """The `share` of the picture [H, W] that lies farthest in the direction `angle`."""
    rows, columns = np.indices((height, width))
    along = np.cos(angle) * (columns - width / 2) + np.sin(angle) * (rows - height / 2)
    return np.asarray(along > np.quantile(along, 1 - share))


def with_instrument(
    clip: DepthClip, covered: NDArray[np.bool_], colour: tuple[int, int, int], random: np.random.Generator
) -> DepthClip:
    """The clip with brushed metal of its own depth and mask where covered [T, H, W]."""
    grain = random.normal(0, BRUSHED_LEVELS, clip.rgb.shape)
    metal = np.clip(np.array(colour) + grain, 0, 255).astype(np.uint8)
    return dataclasses.replace(
        clip,
        rgb=np.where(covered[..., None], metal, clip.rgb),
        tissue=clip.tissue & ~covered,
        depth_mm=np.where(covered, np.float32(TOOL_DEPTH_MM), clip.depth_mm),
        depth_confidence=np.where(covered, np.uint8(255), clip.depth_confidence),
    )
