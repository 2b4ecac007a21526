"""The model before its first step: Gaussians at the points, whose motion starts from the tracks, or at rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.fusion import FusionSettings, PointCloud, nearest_pixels
from intrasplat.methods.method import Preset
from intrasplat.motion.capacity import MAX_POINTS, BasisTrials, choose_bases, choose_stride, mean_floor_error, try_bases
from intrasplat.motion.tracks import GUESSED, Tracks, fit_tracks
from intrasplat.notices import Notice, NoticeCode
from intrasplat.scene.compact import MAX_WEIGHTS
from intrasplat.splat.backend import CPU, Device, make_model
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.deformation import AtRest, SharedBasis, motion_named
from intrasplat.splat.gaussians import NEIGHBOURS, Gaussians, initial_gaussians
from intrasplat.splat.layout import COLOUR, MEAN, ROWS
from intrasplat.splat.model import Model
from intrasplat.train.run import Box
from intrasplat.train.setup import Setup

SHARE_PX = 4
"""Side of a square in which all points start with one motion: tracks are smooth enough, and there is less to solve."""
BETWEEN_KEYFRAMES_MM = 1e4
"""Added between the points of different keyframes, so that none is a neighbour of another keyframe's."""
MIN_STRIDE = 2
"""Least pixels between the points of a grid. A Gaussian for every pixel would fit noise, not surface."""


class Resolved(NamedTuple):
    """A preset without choices left to the scene.

    notices       what was chosen and why, for the report
    motion_error  as in BasisChoice; None where some number of bases follows the motion, or none was tried
    """

    preset: Preset
    notices: tuple[Notice, ...]
    motion_error: float | None


def fusion_for(preset: Preset, intrinsics: Intrinsics) -> FusionSettings:
    """The preset's fusion; "fill" with the stride whose grid comes nearest to points_per_image points."""
    if preset.points_per_image is None or preset.fusion.mode != "fill":
        return preset.fusion
    return dataclasses.replace(preset.fusion, stride=stride_for(preset.points_per_image, intrinsics))


def stride_for(points: int, intrinsics: Intrinsics) -> int:
    """The stride in pixels of a grid of about `points` points per image."""
    return max(MIN_STRIDE, round(math.sqrt(intrinsics.width * intrinsics.height / points)))


def resolve_preset(preset: Preset, tracks: Sequence[Tracks], clip: DepthClip, train: Sequence[int]) -> Resolved:
    """The preset with the stride of the points' grid and the number of bases chosen for the scene, where it leaves them
    open. tracks: of each keyframe, if there are any."""
    motion_error = None
    notices, keys = [], [train[each.reference] for each in tracks] or [train[0]]
    left_open = preset.bases is None or (preset.points_per_image is None and preset.fusion.mode == "fill")
    trials = BasisTrials({})
    if tracks and left_open:
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
        choice = choose_stride(clip, keys, finest, min((each.total for each in trials.decisive.values()), default=0.0))
        fusion = dataclasses.replace(fusion, stride=choice.count)
        preset = dataclasses.replace(preset, fusion=fusion)
        notices.append(
            Notice.info(NoticeCode.SPACING, f"Gaussians start {choice.count} pixels apart: {choice.reason}.")
        )
    if preset.bases is None:
        floor = mean_floor_error(clip, keys, fusion.stride)
        choice = choose_bases(trials, floor, len(train), preset.max_bases)
        preset, motion_error = preset.with_bases(choice.count), choice.motion_error
        notices.append(
            Notice.info(
                NoticeCode.BASES,
                f"Motion has {choice.count} {'basis' if choice.count == 1 else 'bases'}: {choice.reason}.",
            )
        )
    return Resolved(preset, tuple(notices), motion_error)


def bounded(preset: Preset, points: int) -> tuple[Preset, tuple[Notice, ...]]:
    """The resolved preset with no more bases than a scene of so many Gaussians can store, and a notice if fewer."""
    most = MAX_WEIGHTS // (ROWS * points)
    if preset.deformation != SharedBasis.kind or preset.bases is None or preset.bases <= most:
        return preset, ()
    text = f"Motion has {most} of {preset.bases} bases: more would make a scene of more than {MAX_WEIGHTS:,} weights."
    return dataclasses.replace(preset, bases=most), (Notice.info(NoticeCode.BASES, text),)


def basis_values(bases: int, trained_times: Sequence[float], times: Sequence[float]) -> NDArray[np.float64]:
    """[T, B] values, at `times`, of the bases that a shared motion trained on trained_times starts with."""
    return values_at(SharedBasis.initial(1, bases=bases, times=trained_times), times)


def values_at(motion: SharedBasis, times: Sequence[float]) -> NDArray[np.float64]:
    """[T, B] values of the motion's bases at the times."""
    return np.stack([motion.basis(t).double().numpy() for t in times])


def start_model(
    cloud: PointCloud,
    tracks: Sequence[Tracks],
    clip: DepthClip,
    train: Sequence[int],
    preset: Preset,
    scale: float,
    seed: int,
    device: Device = CPU,
    *,
    gloss: bool = False,
) -> Model:
    """Gaussians at the cloud's points, scaled from mm to optimiser units, with the resolved preset's motion.

    A "shared" motion starts from the tracks of the keyframes, if there are any. Every other motion starts at rest.
    gloss: whether two eyes are trained on.
    """
    gaussians = start_gaussians(cloud, preset, scale)
    start = AtRest(preset.bases, preset.start_width, [float(clip.t[i]) for i in train], seed, gloss)
    motion = motion_named(preset.deformation).at_rest(gaussians, start)
    if tracks and isinstance(motion, SharedBasis):
        gaussians = _follow_tracks(gaussians, motion, cloud, tracks, clip, train, scale)
    return make_model(gaussians, motion, clip.intrinsics.width, clip.intrinsics.height, device)


def start_gaussians(cloud: PointCloud, preset: Preset, scale: float) -> Gaussians:
    """Gaussians at the cloud's points, scaled from mm to optimiser units, with the preset's opacity and spread."""
    gaussians = initial_gaussians(
        _apart_by_keyframe_mm(cloud) * np.float32(scale),  # a width depends on neighbours of the same keyframe only
        cloud.rgb,
        sh_degree=preset.sh_degree,
        opacity=preset.opacity,
    )
    return dataclasses.replace(
        gaussians,
        mean=torch.from_numpy(cloud.points_mm * np.float32(scale)),
        log_scale=gaussians.log_scale + math.log(preset.spread),
    )


def _apart_by_keyframe_mm(cloud: PointCloud) -> NDArray[np.float32]:
    """[N, 3] points in their keyframes, each keyframe moved far from the others; a keyframe of few points is not."""
    alone = np.bincount(cloud.key)[cloud.key] <= NEIGHBOURS
    apart_mm = (BETWEEN_KEYFRAMES_MM * np.where(alone, 0, cloud.key)).astype(np.float32)
    return cloud.reference_mm + apart_mm[:, None]


def box_of(model: Model) -> Box:
    """The bounding box of the model's centres, units."""
    centres = model.parameters()["canonical"][MEAN].cpu()
    return tuple(centres.amin(1).tolist()), tuple(centres.amax(1).tolist())


def resting_model(count: int, box: Box, setup: Setup, preset: Preset) -> Model:
    """A model like start_model's, of `count` Gaussians in a bounding box, into which arrays can be loaded."""
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
    tracks: Sequence[Tracks],
    clip: DepthClip,
    train: Sequence[int],
    scale: float,
) -> Gaussians:
    """Fill motion's weights from optical-flow tracks; returns the Gaussians with canonical mean and colour shifted so
    that each has the position and colour of its point at the time of the frame it was taken from."""
    basis = values_at(motion, [float(clip.t[i]) for i in range(clip.frame_count)])
    weights = np.zeros((len(cloud), basis.shape[1], 6), np.float32)
    for key, each in enumerate(tracks):
        rows = np.flatnonzero(cloud.key == key)
        pixels = nearest_pixels(cloud.reference_mm[rows], clip, train[each.reference])
        weights[rows], _ = fit_tracks(
            each, basis[list(train)], pixels, clip.intrinsics.width, share_px=SHARE_PX, guessed=GUESSED
        )
    weights *= np.repeat(np.array([scale, 1 / SH_C0], np.float32), 3)
    by_channel = torch.from_numpy(weights).permute(0, 2, 1)
    motion.weight[:, MEAN], motion.weight[:, COLOUR] = by_channel[:, :3], by_channel[:, 3:]
    moved = torch.from_numpy(np.einsum("nbc,nb->nc", weights, basis[cloud.frame]).astype(np.float32))
    colour = torch.cat([gaussians.sh[:, :1] - moved[:, None, 3:], gaussians.sh[:, 1:]], 1)
    return dataclasses.replace(gaussians, mean=gaussians.mean - moved[:, :3], sh=colour)
