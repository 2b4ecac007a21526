"""Remove Gaussians that the clip never saw.

Symbols: N Gaussians, H W pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.clip import spread
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import CX, CY, FX, FY, POSE
from intrasplat.splat.model import Model
from intrasplat.train.targets import TrainingFrames

SAMPLED_FRAMES = 24
"""Number of training frames that are sampled, evenly spread."""

MAX_UNSEEN_WIDTH = 3.0
"""Largest width at any time of the clip of a Gaussian that no frame saw, in units: a twentieth of the median depth."""
MISSED_IN_FRAMES, MISSED_DB = 8, 0.02
"""Number of training frames, evenly spread, and how much psnr_tissue any of them may lose with a removed Gaussian."""
HIDDEN_LOGIT = -30.0
"""Opacity logit at which nothing is drawn."""


def drop_strays(model: Model, eyes: Sequence[TrainingFrames]) -> int:
    """Remove Gaussians that lay on tissue in no training frame, grew wide, and are not missed there; return how many.
    Adam's moments are removed, too: the model is trained.

    Where an instrument never leaves, only a Gaussian's tail on the tissue beside it constrains it. A few grow wide at
    times when no frame sees them, and from another pose they cover the tissue like a veil. But among few, large
    Gaussians, one whose centre is never on tissue may still show much of it: such a Gaussian would be missed.
    """
    unseen = np.flatnonzero(~_ever_on_tissue(model, eyes))
    sampled = spread(eyes[0].indices, SAMPLED_FRAMES)
    widest = _widest(model, unseen, [float(eyes[0].t[index]) for index in sampled])
    strays = _not_missed(model, eyes, unseen[widest > MAX_UNSEEN_WIDTH])
    if len(strays) == model.count:
        strays = strays[:0]
    kept = np.setdiff1d(np.arange(model.count), strays)
    model.take(kept.astype(np.int64), np.ones(len(kept), np.bool_))  # mark all as new: moments of 0 take no memory
    return len(strays)


def _not_missed(model: Model, eyes: Sequence[TrainingFrames], wide: NDArray[np.intp]) -> NDArray[np.intp]:
    """Those of `wide` [M] without which no sampled frame gets worse: all, or those found one by one."""
    if not len(wide):
        return wide
    opacity_logit = model.parameters()["opacity_logit"]
    trained = opacity_logit.clone()
    judged = [(eye, index) for eye in eyes for index in spread(eye.indices, MISSED_IN_FRAMES)]

    def scores_db() -> NDArray[np.float64]:
        renders = ((eye, index, model.render(eye.cameras[index], float(eye.t[index]))) for eye, index in judged)
        return np.array([eye.psnr_tissue_db(index, image) for eye, index, image in renders])

    def goes(rows: torch.Tensor) -> bool:
        opacity_logit[rows] = HIDDEN_LOGIT
        if (with_all_db - scores_db() > MISSED_DB).any():
            opacity_logit[rows] = trained[rows]
            return False
        return True

    with_all_db, rows = scores_db(), torch.from_numpy(wide)
    found = wide if goes(rows) else np.array([int(row) for row in rows if goes(row[None])], np.intp)
    opacity_logit.copy_(trained)
    return found


def _ever_on_tissue(model: Model, eyes: Sequence[TrainingFrames]) -> NDArray[np.bool_]:
    """[N] whether the centre projects onto a tissue pixel in any training frame of any eye, hidden or not."""
    found = np.zeros(model.count, np.bool_)
    for index in eyes[0].indices:
        mean = model.deformed_mean(float(eyes[0].t[index]))
        for frames in eyes:
            sought = np.flatnonzero(~found)  # only a few after the first frames
            inside, i, j = _pixels(mean[:, sought], frames, index)
            found[sought[inside]] = frames.eye.tissue[index][i, j]
            frames.eye.let_go(index)
    return found


def _widest(model: Model, chosen: NDArray[np.intp], times: Sequence[float]) -> NDArray[np.float32]:
    """The largest scale of each chosen Gaussian at any of the times, in units."""
    if not len(chosen):
        return np.zeros(0, np.float32)
    everything, deformation = model.export()
    rows = torch.from_numpy(chosen)
    gaussians = Gaussians(*(getattr(everything, each.name)[rows] for each in dataclasses.fields(Gaussians)))
    motion = deformation.select(rows)
    widest = np.zeros(len(chosen), np.float32)
    with torch.no_grad():
        for t in times:
            scale = motion.deform(gaussians, t).log_scale.exp()
            widest = np.maximum(widest, scale.numpy().max(axis=1, initial=0.0))
    return widest


def _pixels(
    mean: NDArray[np.float32], frames: TrainingFrames, index: int
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Which centres (mean [3, N], units) project into frame `index`, and their rows and columns."""
    camera, (height, width) = frames.cameras[index], frames.eye.tissue[index].shape
    x, y, z = _camera_points(mean, camera)
    column, row = np.floor(camera[FX] * x / z + camera[CX]), np.floor(camera[FY] * y / z + camera[CY])
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside, row[inside].astype(np.intp), column[inside].astype(np.intp)


def _camera_points(
    mean: NDArray[np.float32], camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Camera x, y, z of means [3, N]; z that is not positive becomes -1, so that nothing divides by 0."""
    pose = camera[POSE:].reshape(3, 4)
    points = pose[:, :3] @ mean + pose[:, 3:]
    z = np.where(points[2] > 0, points[2], -1.0)
    return points[0], points[1], z
