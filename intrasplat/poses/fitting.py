"""Cameras and the tissue's motion, fitted together to all links.

Outliers lose weight: a match by its residual, a cell of tissue by the residuals of all its links (its rigidity). The
tissue's motion starts from sines and cosines of the period that explains the links best. If free time courses explain
the links better, as for a pull, they replace the sines.

Symbols: K frames, L links, M matches of a link.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from intrasplat.machine.hooks import ignore
from intrasplat.poses.chain import Chain
from intrasplat.poses.field import HARMONICS, DeformationField, waves
from intrasplat.poses.grams import Grams, LinkGram, link_gram
from intrasplat.poses.links import FrameLink
from intrasplat.poses.rigid import Reals, StereoCamera, exp

ROUGH_PX, FINE_PX = (4.0, 3.0, 2.0), (2.0, 1.5, 1.0, 0.8, 0.8)
"""Maximum robust scale of each round, the residual at which a match has a quarter of its weight: rounds without the
tissue's motion, then rounds with it."""
SETTLING = 4
"""Extra rounds at the last scale, until a wide pan has converged: without them it is 0.1 degrees farther off."""
TUNED, FOLLOWED = (2, 4), (1, 2, 3)
"""Indices of the fine rounds that tune the period, and of those that fit free courses."""
DEGREE, WIDE_DEGREE, WIDE = 3, 5, 1.5
"""Degree of the polynomials. The second applies where the tissue is more than WIDE times as wide or high as a view."""
PERIODS, MIN_PERIOD_S, MIN_PERIOD_FRAMES, MIN_PERIODS = 48, 0.32, 2.2, 1.25
"""Number of periods that are tried; the shortest, in seconds and in frames; how often the longest fits into the
clip."""
NEAR = np.linspace(0.94, 1.06, 25)
"""Factors on the current period that are tried to tune it."""
MIN_EXPLAINED = 0.08
"""Share of the residual of rigid tissue that a period must explain; still tissue has less than 0.01."""
MIN_GAIN = 0.05
"""Share of the loss that free courses must save: with breathing they cost 0.01, with a pull they save 0.06."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Cameras and tissue motion that explain the links.

    poses        [K, 4, 4] world_from_camera; the world is the first frame's camera
    field        the tissue's motion
    middle_mm    [3] the middle of the visible tissue
    residual_px, weight  for each link [M]: lengths of the residuals, robust weights
    grams        Gram matrices of the links at this solution
    """

    poses: Reals
    field: DeformationField
    middle_mm: Reals
    residual_px: Sequence[Reals]
    weight: Sequence[Reals]
    grams: Grams


def fitted(
    camera: StereoCamera,
    chain: Chain,
    frame_s: float,
    pool: ThreadPoolExecutor,
    on_progress: Callable[[float], None] = ignore,
) -> Fit:
    """Cameras and the tissue's motion.

    frame_s: seconds from frame to frame of the clip. pool: measures the links. on_progress gets the share of rounds
    done; its exceptions pass through.
    """
    fitting, rounds = _Fitting(camera, chain, frame_s, pool), len(ROUGH_PX) + len(FINE_PX) + SETTLING
    for done, scale_px in enumerate(ROUGH_PX):
        on_progress(done / rounds)
        fitting.improve(scale_px)
    best, periodic = fitting, fitting.find_period(FINE_PX[0])
    fitting.improve(FINE_PX[0])
    free = copy(fitting)  # a shallow copy is enough: no step changes an array in place
    for place, scale_px in enumerate(FINE_PX[1:], start=1):
        on_progress((len(ROUGH_PX) + place) / rounds)
        (fitting.tune if periodic and place in TUNED else fitting.improve)(scale_px)
        if periodic:
            (free.follow if place in FOLLOWED else free.improve)(scale_px)
    if periodic and free.loss() < (1 - MIN_GAIN) * fitting.loss():
        best = free
    for place in range(SETTLING):
        on_progress((len(ROUGH_PX) + len(FINE_PX) + place) / rounds)
        best.improve(FINE_PX[-1])
    return best.result()


class _Fitting:
    """A fit in progress."""

    def __init__(self, camera: StereoCamera, chain: Chain, frame_s: float, pool: ThreadPoolExecutor) -> None:
        self.pool = pool
        self.shortest = max(MIN_PERIOD_S / frame_s, MIN_PERIOD_FRAMES)
        self.camera, self.links, self.poses = camera, chain.links, chain.world_from_camera
        place = {index: k for k, index in enumerate(chain.frames)}
        self.ends = [(place[each.a], place[each.b]) for each in chain.links]
        self.frames = np.asarray(chain.frames, np.float64)
        self.incidence = np.zeros((len(self.ends), len(self.frames)))
        for row, (a, b) in zip(self.incidence, self.ends, strict=True):
            row[a], row[b] = 1, -1
        seen = [self._some(link, self.poses[a]) for link, (a, _) in zip(self.links, self.ends, strict=True)]
        places = np.concatenate(seen)
        self.middle_mm = np.median(places, axis=0)
        low, high = np.percentile(places[:, :2], [1, 99], axis=0)
        half = (high - low) / 2 + 1e-6
        view = np.median([np.ptp(each[:, :2], axis=0) for each in seen], axis=0) / 2
        degree = WIDE_DEGREE if (half > WIDE * view).any() else DEGREE
        self.field = DeformationField.at_rest(degree, (low + high) / 2, half, len(self.frames))
        self.rigidity: dict[int, Reals] = {}
        self.residual_px: list[Reals] = []
        self.weight: list[Reals] = []

    def improve(self, scale_px: float) -> None:
        """One step of cameras and field."""
        twists, bend = self._measured(scale_px).solved(self.field)
        self._move(twists, replace(self.field, weight=self.field.weight + bend))

    def follow(self, scale_px: float) -> None:
        """One step of the field's weights, then one of cameras and free courses."""
        grams = self._measured(scale_px)
        _, bend = grams.solved(self.field)
        field = replace(self.field, weight=self.field.weight + bend)
        twists, change = grams.with_weights(field, bend).followed(field)
        courses = field.courses + change
        even, size = np.linalg.qr(courses - courses.mean(0))
        root = np.sqrt(len(self.frames))
        self._move(twists, replace(field, courses=even * root, weight=size / root @ field.weight))

    def tune(self, scale_px: float) -> None:
        """One step of cameras and field with the best period near the current one."""
        assert self.field.period is not None
        self._start_with(self._measured(scale_px).without(self.field), self.field.period * NEAR)

    def find_period(self, scale_px: float) -> bool:
        """Whether some period explains enough; if so, one step of cameras and field with it."""
        grams = self._measured(scale_px)
        span = self.frames[-1] - self.frames[0]
        if span < MIN_PERIODS * self.shortest:
            return False
        periods = np.geomspace(self.shortest, span / MIN_PERIODS, PERIODS)
        gains = grams.explained(self.field, periods.tolist())
        best = int(np.argmax(gains))
        if gains[best] < MIN_EXPLAINED * grams.unexplained():
            return False
        self._start_with(grams, periods[best] * NEAR)
        return True

    def loss(self) -> float:
        """Mean of r^2 / (1 + r^2) over the matches before the last step."""
        squared = np.square(np.concatenate(self.residual_px))
        trust = np.concatenate([each.trust for each in self.links])
        return float((trust * squared / (1 + squared)).sum() / trust.sum())

    def result(self) -> Fit:
        """The current fit."""
        grams = self._measured(FINE_PX[-1])
        return Fit(self.poses, self.field, self.middle_mm, self.residual_px, self.weight, grams)

    def _start_with(self, grams: Grams, periods: Reals) -> None:
        """Use the best of the periods and solve for the field anew. grams: those of the links without a field."""
        period = float(periods[np.argmax(grams.explained(self.field, periods.tolist()))])
        courses, count = waves(self.frames, period), self.field.weight.shape[1]
        field = replace(self.field, period=period, courses=courses, weight=np.zeros((2 * HARMONICS, count)))
        twists, bend = grams.solved(field)
        self._move(twists, replace(field, weight=bend))

    def _move(self, twists: Reals, field: DeformationField) -> None:
        self.field = field
        self.poses = np.stack([exp(each) @ pose for each, pose in zip(twists, self.poses, strict=True)])

    def _measured(self, scale_px: float) -> Grams:
        """The links' Gram matrices at the current solution; updates residuals, weights and rigidity."""
        courses = self.field.courses

        def measured(link: FrameLink, ends: tuple[int, int]) -> LinkGram:
            a, b = ends
            poses, change = (self.poses[a], self.poses[b]), courses[b] - courses[a]
            return link_gram(self.camera, link, poses, self.field, change, scale_px, self.rigidity.get(link.a))

        found = list(self.pool.map(measured, self.links, self.ends))
        self.residual_px, self.weight = [each.residual_px for each in found], [each.weight for each in found]
        self.rigidity = rigidity(self.links, self.weight)
        return Grams(np.stack([each.gram for each in found]), self.incidence, self.frames)

    def _some(self, link: FrameLink, pose: Reals) -> Reals:
        """Points of every sixteenth match of a link, world frame, mm."""
        return self.camera.points_mm(link.before[::16]) @ pose[:3, :3].T + pose[:3, 3]


def rigidity(links: Sequence[FrameLink], weight: Sequence[Reals]) -> dict[int, Reals]:
    """For each first frame: per cell, the squared mean weight over its links, with one prior observation of a half."""
    cells = 1 + max(int(link.cells.max(initial=0)) for link in links)
    total = {link.a: np.full(cells, 0.5) for link in links}
    count = {link.a: np.ones(cells) for link in links}
    for link, each in zip(links, weight, strict=True):
        total[link.a][link.cells] += each
        count[link.a][link.cells] += 1
    return {a: np.square(total[a] / count[a]) for a in total}
