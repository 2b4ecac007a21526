"""Smoke between the endoscope and the tissue: a cloud that takes light from the tissue and adds its own grey.

recorded = passes * tissue + (1 - passes) * AIRLIGHT, where passes = exp(-density * depth) is the share of light that
reaches the eye. The density is smooth over the picture and drifts. Both eyes look through the same cloud. with_smoke()
takes any clip, of one eye or two, and so does with_haze(), whose density is even and comes and goes.

Symbols: T frames, H W pixels. Lengths in pixels refer to a picture 640 wide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip, Eye
from intrasplat.motion.complete import complete_depth
from lab.conditions.clean import REFERENCE_WIDTH, CleanClip, Given, given, to_bytes
from lab.conditions.recording import recording_of
from lab.phantom import PhantomFrame

AIRLIGHT = 205.0  # light grey
PUFF_PX, DRIFT_PX, UNEVEN = 40.0, 12.0, 0.35  # sigma of a puff, drift per frame, deviation of the density, mean 1
CLOUD_AT = 0.5  # of the way to the tissue hangs the cloud: its parallax is that of this distance
HAZE_PERIODS = 1.5  # of a haze in the clip; each is clear for its other half
MAX_DENSITY = 50.0  # thickest smoke that is tried, times the depth
COARSE = 4  # depth is completed at a fraction of the resolution


@dataclass(frozen=True, eq=False)
class Smoke:
    """A drifting cloud.

    density      [H, more than W] float32, 1/mm
    drift_px     it moves to the left by so many pixels per frame
    parallax_px  the right eye sees it so much farther to the left
    """

    density: NDArray[np.float32]
    drift_px: float
    parallax_px: float

    def passes(self, index: int, depth_mm: NDArray[np.float32], *, right: bool = False) -> NDArray[np.float32]:
        """[H, W] share of light that reaches an eye in frame `index`; depth_mm [H, W] of that eye, 0: not known."""
        start = round(index * self.drift_px + self.parallax_px * right)
        density = self.density[:, start : start + depth_mm.shape[1]]
        return np.asarray(np.exp(-density * _everywhere(depth_mm)), np.float32)

    def over(
        self, rgb: NDArray[np.uint8], index: int, depth_mm: NDArray[np.float32], *, right: bool = False
    ) -> NDArray[np.uint8]:
        """The picture [H, W, 3] of an eye through the cloud; else as passes()."""
        passes = self.passes(index, depth_mm, right=right)[..., None]
        return to_bytes(passes * rgb + (1 - passes) * np.float32(AIRLIGHT))


def smoke_before(
    depth_mm: NDArray[np.float32], level: float, random: np.random.Generator, focal_baseline: float = 0.0
) -> Smoke:
    """A cloud that takes `level` of the light, as the mean over the clip, from a left eye with depth [T, H, W].

    focal_baseline: focal length in px times the distance of the eyes in mm; 0: there is no right eye.
    """
    frames, height, width = depth_mm.shape
    px = width / REFERENCE_WIDTH
    usual_mm = float(np.median(depth_mm[depth_mm > 0]))
    parallax_px = focal_baseline / (CLOUD_AT * usual_mm)
    wide = width + int(DRIFT_PX * px * frames + parallax_px) + 2
    cloud = cv2.GaussianBlur(random.standard_normal((height, wide)), (0, 0), PUFF_PX * px)
    uneven = np.maximum(1 + UNEVEN * cloud / cloud.std(), 0).astype(np.float32)
    smoke = Smoke(uneven / np.float32(usual_mm), DRIFT_PX * px, parallax_px)
    thin, thick = 0.0, MAX_DENSITY
    unit = np.stack([-np.log(smoke.passes(index, each)) for index, each in enumerate(depth_mm)])[:, ::COARSE, ::COARSE]
    for _ in range(40):  # halves the interval to 1e-10
        middle = (thin + thick) / 2
        thin, thick = (middle, thick) if 1 - np.exp(-middle * unit).mean() < level else (thin, middle)
    return dataclasses.replace(smoke, density=smoke.density * np.float32(middle))


def with_smoke(clip: DepthClip, level: float, random: np.random.Generator) -> DepthClip:
    """Any clip with depth, through smoke that takes `level` of the light; both eyes if it has them. Depth stays."""
    right, focal_baseline = clip.right, 0.0
    if right is not None:
        apart_mm = np.linalg.norm(right.world_from_camera[0, :3, 3] - clip.world_from_camera[0, :3, 3])
        focal_baseline = clip.intrinsics.fx * float(apart_mm)
    smoke = smoke_before(clip.depth_mm, level, random, focal_baseline)
    veiled_right = None if right is None else dataclasses.replace(right, rgb=_seen(smoke, right, right=True))
    return dataclasses.replace(clip, rgb=_seen(smoke, clip, right=False), right=veiled_right)


def with_haze(clip: DepthClip, level: float, random: np.random.Generator) -> DepthClip:
    """Any clip with depth, through even smoke that comes and goes, and takes `level` of the light at most; as above."""
    phase = random.uniform(0, 2 * np.pi) + 2 * np.pi * HAZE_PERIODS * np.arange(clip.frame_count) / clip.frame_count
    density = -np.log1p(-level * np.maximum(np.sin(phase), 0)) / float(np.median(clip.depth_mm[clip.depth_mm > 0]))
    everywhere = np.ones(clip.tissue.shape[1:], np.float32)

    def seen(eye: Eye) -> NDArray[np.uint8]:
        smokes = [Smoke(each * everywhere, 0.0, 0.0) for each in density.astype(np.float32)]
        return np.stack([smoke.over(eye.rgb[index], index, eye.depth_mm[index]) for index, smoke in enumerate(smokes)])

    right = clip.right and dataclasses.replace(clip.right, rgb=seen(clip.right))
    return dataclasses.replace(clip, rgb=seen(clip), right=right)


def smoke(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Smoke takes `level` of the light."""
    return given(clean, with_smoke(clean.clip, level, random))


def smoke_stereo(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of the same."""
    phantom, settings = clean.phantom, clean.phantom.settings
    cloud = smoke_before(clean.clip.depth_mm, level, random, settings.intrinsics.fx * settings.baseline_mm)

    def spoil(frame: PhantomFrame, index: int) -> PhantomFrame:
        depth_right_mm = phantom.surface_pixels(index, phantom.world_from_right(index)).depth_mm
        return dataclasses.replace(
            frame,
            left=cloud.over(frame.left, index, frame.depth_mm),
            right=cloud.over(frame.right, index, depth_right_mm, right=True),
        )

    return given(clean, recording_of(phantom, spoil))


def _seen(smoke: Smoke, eye: Eye, *, right: bool) -> NDArray[np.uint8]:
    frames: Iterable[tuple[int, NDArray[np.uint8]]] = enumerate(eye.rgb)
    return np.stack([smoke.over(rgb, index, eye.depth_mm[index], right=right) for index, rgb in frames])


def _everywhere(depth_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] without gaps: completed where it is 0."""
    known = depth_mm > 0
    if known.all():
        return depth_mm
    coarse = np.ascontiguousarray(depth_mm[::COARSE, ::COARSE])
    filled = complete_depth(coarse, coarse > 0, np.ones_like(coarse, np.bool_))
    size = depth_mm.shape[::-1]
    return np.where(known, depth_mm, cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)).astype(np.float32)
