"""A scene of one moment: its tissue's points as Gaussians without motion, to show until there is a model."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from intrasplat.clip import DepthClip
from intrasplat.fusion import FusionSettings, fuse
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import initial_gaussians
from intrasplat.train.start import stride_for
from intrasplat.train.targets import units_per_mm

POINTS = 20_000
OPACITY = 0.95
WIDER = 0.8
"""Standard deviation of a Gaussian over the distance to its neighbours: views from a few degrees aside show no gaps."""


def first_picture(moment: DepthClip) -> TrainedScene:
    """The scene of a clip of one frame. Nothing in it was trained: seen is 0, and so is the confidence.

    Raises:
        InputError: the frame has no valid depth on tissue.
    """
    fusion = FusionSettings(mode="fill", stride=stride_for(POINTS, moment.intrinsics))
    cloud, scale = fuse(moment, [0], fusion, seed=0), units_per_mm(moment, [0])
    gaussians = initial_gaussians(cloud.points_mm * np.float32(scale), cloud.rgb, sh_degree=0, opacity=OPACITY)
    return TrainedScene(
        gaussians=dataclasses.replace(gaussians, log_scale=gaussians.log_scale + math.log(WIDER)),
        deformation=SharedBasis.initial(len(gaussians), bases=1),
        intrinsics=moment.intrinsics,
        world_from_camera=moment.world_from_camera,
        frame_times_s=moment.frame_times_s,
        units_per_mm=scale,
        preset="first picture",
        trained_t=(0.0,),
        seen=torch.zeros(len(gaussians)),
    )
