"""The model before its first step: points become Gaussians; motion starts from the tracks, or at rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from contract.wire.notices import Notice, NoticeCode
from worker.fusion import FusionSettings, PointCloud
from worker.input.camera import Intrinsics, to_camera
from worker.input.clip import DepthClip
from worker.model.constants import SH_C0
from worker.model.deformation import AtRest, SharedBasis, motion_named
from worker.model.gaussians import Gaussians, initial_gaussians
from worker.model.layout import COLOUR, MEAN, ROWS
from worker.motion.capacity import MAX_POINTS, Trials, choose_bases, choose_stride, floor_error, try_bases
from worker.motion.tracks import GUESSED, Tracks, fit_tracks
from worker.raster.backend import CPU, Device, make_model
from worker.raster.model import Model
from worker.scene.compact import MAX_WEIGHTS
from worker.train.presets import Preset
from worker.train.run import Box
from worker.train.setup import Setup

SHARE_PX = 4
"""Points within such a square start with one motion. Tracks are smooth over more, and there is less to solve."""
MIN_STRIDE = 2
"""Pixels between the points of a grid. A Gaussian for every pixel would fit noise, not surface."""


def fusion_for(preset: Preset, intrinsics: Intrinsics) -> FusionSettings:
    """The preset's fusion; "fill" with the stride whose grid comes nearest to points_per_image points."""
    if preset.points_per_image is None or preset.fusion.mode != "fill":
        return preset.fusion
    return dataclasses.replace(preset.fusion, stride=stride_for(preset.points_per_image, intrinsics))


def stride_for(points: int, intrinsics: Intrinsics) -> int:
    return max(MIN_STRIDE, round(math.sqrt(intrinsics.width * intrinsics.height / points)))


def settled(
    preset: Preset, tracks: Tracks | None, clip: DepthClip, train: Sequence[int]
) -> tuple[Preset, tuple[Notice, ...]]:
    """The preset with what it leaves to the scene settled (decisions 014, 018), and why, in words for the report."""
    notices = []
    left_open = preset.bases is None or (preset.points_per_image is None and preset.fusion.mode == "fill")
    trials = Trials({})
    if tracks is not None and left_open:
        trials = try_bases(tracks, clip, train, basis_values, preset.max_bases)
    fusion = fusion_for(preset, clip.intrinsics)
    if fusion.mode == "fill" and preset.points_per_image is not None:
        least = ", the least there is" if fusion.stride == MIN_STRIDE else ""
        wanted = preset.points_per_image
        notices.append(
            Notice.info(
                NoticeCode.SPACING,
                f"Gaussians start {fusion.stride} pixels apart{least}: {wanted} an image were asked for.",
            )
        )
    elif fusion.mode == "fill":
        finest = stride_for(MAX_POINTS, clip.intrinsics)
        choice = choose_stride(
            clip, train[0], finest, min((each.total for each in trials.decisive.values()), default=0.0)
        )
        fusion = dataclasses.replace(fusion, stride=choice.count)
        preset = dataclasses.replace(preset, fusion=fusion)
        notices.append(
            Notice.info(NoticeCode.SPACING, f"Gaussians start {choice.count} pixels apart: {choice.reason}.")
        )
    if preset.bases is None:
        floor = floor_error(clip, train[0], fusion.stride)
        choice = choose_bases(trials, floor, len(train), preset.max_bases)
        preset = preset.with_bases(choice.count)
        notices.append(
            Notice.info(
                NoticeCode.BASES,
                f"Motion has {choice.count} {'basis' if choice.count == 1 else 'bases'}: {choice.reason}.",
            )
        )
    return preset, tuple(notices)


def bounded(preset: Preset, points: int) -> tuple[Preset, tuple[Notice, ...]]:
    """The settled preset with so few bases that a scene of so many Gaussians can be stored, and the notice of it."""
    most = MAX_WEIGHTS // (ROWS * points)
    if preset.deformation != SharedBasis.kind or preset.bases is None or preset.bases <= most:
        return preset, ()
    text = f"Motion has {most} of {preset.bases} bases: more would make a scene of more than {MAX_WEIGHTS:,} weights."
    return dataclasses.replace(preset, bases=most), (Notice.info(NoticeCode.BASES, text),)


def basis_values(bases: int, trained_times: Sequence[float], times: Sequence[float]) -> NDArray[np.float64]:
    """[T, B] values at the times of the bases that a shared motion trained on trained_times starts with."""
    return values_at(SharedBasis.initial(1, bases=bases, times=trained_times), times)


def values_at(motion: SharedBasis, times: Sequence[float]) -> NDArray[np.float64]:
    """[T, B] values of the motion's bases at the times."""
    return np.stack([motion.basis(t).double().numpy() for t in times])


def start_model(
    cloud: PointCloud,
    tracks: Tracks | None,
    clip: DepthClip,
    train: Sequence[int],
    preset: Preset,
    scale: float,
    seed: int,
    device: Device = CPU,
    *,
    gloss: bool = False,
) -> Model:
    """Gaussians at the cloud's points, scaled from mm to optimiser units, with the motion of the (settled) preset.

    A "shared" motion starts from the tracks if there are any. Every other motion starts at rest. gloss: whether two
    eyes teach.
    """
    gaussians = initial_gaussians(
        cloud.reference_mm * np.float32(scale),  # widths are by neighbours of one time
        cloud.rgb,
        sh_degree=preset.sh_degree,
        opacity=preset.opacity,
    )
    gaussians = dataclasses.replace(
        gaussians,
        mean=torch.from_numpy(cloud.points_mm * np.float32(scale)),
        log_scale=gaussians.log_scale + math.log(preset.spread),
    )
    start = AtRest(preset.bases, preset.start_width, [float(clip.t[i]) for i in train], seed, gloss)
    motion = motion_named(preset.deformation).at_rest(gaussians, start)
    if tracks is not None and isinstance(motion, SharedBasis):
        gaussians = _follow_tracks(gaussians, motion, cloud, tracks, clip, train, scale)
    return make_model(gaussians, motion, clip.intrinsics.width, clip.intrinsics.height, device)


def box_of(model: Model) -> Box:
    """The corners of the box of the model's centres, units."""
    centres = model.parameters()["canonical"][MEAN].cpu()
    return tuple(centres.amin(1).tolist()), tuple(centres.amax(1).tolist())


def resting_model(count: int, box: Box, setup: Setup, preset: Preset) -> Model:
    """As start_model's for as many Gaussians in such a box, whose arrays are still to be loaded."""
    gaussians = Gaussians(
        mean=torch.tensor(box)[torch.arange(count) % 2],
        quaternion=torch.zeros(count, 4),
        log_scale=torch.zeros(count, 3),
        opacity_logit=torch.zeros(count),
        sh=torch.zeros(count, (preset.sh_degree + 1) ** 2, 3),
    )
    clip, times = setup.clip, [float(setup.clip.t[i]) for i in setup.split.train]
    start = AtRest(preset.bases, preset.start_width, times, setup.options.seed, any(setup.sides))
    motion = motion_named(preset.deformation).at_rest(gaussians, start)
    return make_model(gaussians, motion, clip.intrinsics.width, clip.intrinsics.height, setup.device)


def _follow_tracks(
    gaussians: Gaussians,
    motion: SharedBasis,
    cloud: PointCloud,
    tracks: Tracks,
    clip: DepthClip,
    train: Sequence[int],
    scale: float,
) -> Gaussians:
    """Fill motion's weights from optical-flow tracks; returns the Gaussians with each canonical mean and colour shifted
    so that they pass through their point and its colour at the time of the frame it was taken from."""
    basis = values_at(motion, [float(clip.t[i]) for i in range(clip.frame_count)])
    pixels = _reference_pixels(cloud, clip, train[0])
    width = clip.intrinsics.width
    weights, _ = fit_tracks(tracks, basis[list(train)], pixels, width, share_px=SHARE_PX, guessed=GUESSED)
    weights *= np.repeat(np.array([scale, 1 / SH_C0], np.float32), 3)
    by_channel = torch.from_numpy(weights).permute(0, 2, 1)
    motion.weight[:, MEAN], motion.weight[:, COLOUR] = by_channel[:, :3], by_channel[:, 3:]
    moved = torch.from_numpy(np.einsum("nbc,nb->nc", weights, basis[cloud.frame]).astype(np.float32))
    colour = torch.cat([gaussians.sh[:, :1] - moved[:, None, 3:], gaussians.sh[:, 1:]], 1)
    return dataclasses.replace(gaussians, mean=gaussians.mean - moved[:, :3], sh=colour)


def _reference_pixels(cloud: PointCloud, clip: DepthClip, reference: int) -> NDArray[np.intp]:
    """[N] flat index of the pixel of the reference frame each point lay in, the nearest one if outside."""
    pose, k = clip.world_from_camera[reference], clip.intrinsics
    x, y, z = to_camera(cloud.reference_mm, pose).T
    z = np.maximum(z, 1e-6)
    column = np.clip(np.floor(k.fx * x / z + k.cx), 0, k.width - 1)
    row = np.clip(np.floor(k.fy * y / z + k.cy), 0, k.height - 1)
    pixels: NDArray[np.intp] = (row * k.width + column).astype(np.intp)
    return pixels
