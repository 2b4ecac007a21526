"""Tissue motions: each maps points at rest to their positions at a frame.

Points are [..., 3] float64, mm, in the world (the endoscope's camera of frame 0: x right, y down, z away). A frame is a
real number: motion is defined between frames, too. P is the period in frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lab.phantom.fields import smoothstep

Points = NDArray[np.float64]

HEAVE_MM = 4.5  # towards the camera and back, in quiet breathing
SWAY_MM = (3.0, 1.6)  # right and down
BREATH_DELAY_RAD_PER_MM = 0.012  # the far side follows the near side
BREATH_REACH_MM = 70.0

GRIP_MM = (5.0, 4.0)  # where the grasper takes hold, (x, y) at rest
PULL_NEAR_MM, PULL_NEAR_REACH_MM = (9.0, -6.0, -14.0), 12.0  # the fold that is lifted
PULL_FAR_MM, PULL_FAR_REACH_MM = (5.0, -2.0, -4.0), 34.0  # what hangs on it
PINCH = 0.22  # share of its distance from the grip that tissue is drawn in
TREMOR_MM = 0.35
RELEASE = 0.68  # share of a pull's period after which the grasper lets go

CUT_HALF_LENGTH_MM = 20.0
CUT_SLANT = 0.3  # mm to the right for each mm down
CUT_HALF_WIDTH_MM = 6.5
CUT_GAPE_MM = 12.0  # behind the blade the cut opens to its full width over this length
CUT_REACH_MM = 16.0  # the sides give way over this distance
CUT_LIP_MM, CUT_LIP_REACH_MM = 1.6, 4.0  # the lips curl up
CUT_DEPTH_PER_WIDTH, MAX_CUT_DEPTH_MM = 1.5, 8.0


class TissueMotion(Protocol):
    def __call__(self, rest_mm: Points, frame: float) -> Points:
        """Positions at a frame, in mm, of points at rest [..., 3]."""
        ...


@dataclass(frozen=True)
class Still:
    def __call__(self, rest_mm: Points, frame: float) -> Points:
        return rest_mm


@dataclass(frozen=True)
class Breathing:
    """Heave and sway with period P; strength scales both."""

    period_frames: float
    strength: float = 1.0

    def __call__(self, rest_mm: Points, frame: float) -> Points:
        x, y = rest_mm[..., 0], rest_mm[..., 1]
        phase = 2 * np.pi * frame / self.period_frames - BREATH_DELAY_RAD_PER_MM * x
        breath = np.sin(phase) + 0.2 * np.sin(2 * phase)  # breathing in is quicker than breathing out
        reach = 0.45 + 0.55 * np.exp(-(x**2 + y**2) / (2 * BREATH_REACH_MM**2))
        moved = rest_mm.copy()
        moved[..., 0] += self.strength * SWAY_MM[0] * reach * np.sin(phase - 0.7)
        moved[..., 1] += self.strength * SWAY_MM[1] * reach * np.sin(phase + 0.9)
        moved[..., 2] -= self.strength * HEAVE_MM * reach * breath
        return moved


@dataclass(frozen=True)
class Pull:
    """A grasper lifts a fold about GRIP_MM, drags it aside, holds it and lets go; it repeats every P frames."""

    period_frames: float

    def strength(self, frame: float) -> float:
        """Progress of the pull: 0 at rest, 1 held. After the release it swings once past 0."""
        p = (frame / self.period_frames) % 1.0
        rise = float(smoothstep(np.array(p), 0.08, 0.5))
        if p < RELEASE:
            return rise
        since = (p - RELEASE) / (1 - RELEASE)
        return float(np.exp(-6 * since) * np.cos(2.5 * np.pi * since) * (1 - since))

    def __call__(self, rest_mm: Points, frame: float) -> Points:
        strength = self.strength(frame)
        x, y = rest_mm[..., 0] - GRIP_MM[0], rest_mm[..., 1] - GRIP_MM[1]
        squared = x**2 + y**2
        near = strength * np.exp(-squared / (2 * PULL_NEAR_REACH_MM**2))[..., None]
        far = strength * np.exp(-squared / (2 * PULL_FAR_REACH_MM**2))[..., None]
        moved: Points = rest_mm + near * np.array(PULL_NEAR_MM) + far * np.array(PULL_FAR_MM)
        moved[..., 0] += near[..., 0] * (TREMOR_MM * np.sin(1.9 * frame) - PINCH * x)
        moved[..., 1] += near[..., 0] * (TREMOR_MM * np.sin(2.3 * frame) - PINCH * y)
        return moved


@dataclass(frozen=True)
class Cut:
    """The surface splits along a slanted line, from the top down within 2 P frames, stays open, and breathes a little.

    In move(), side is -1 for points of the left lip and +1 for the right lip.
    """

    period_frames: float

    def blade_mm(self, frame: float) -> float:
        """y of the blade, at rest: -CUT_HALF_LENGTH_MM when the cut starts, +CUT_HALF_LENGTH_MM when it ends."""
        done = float(smoothstep(np.array(frame / (2 * self.period_frames)), 0.02, 1.0))
        return CUT_HALF_LENGTH_MM * (2 * done - 1)

    def half_width_mm(self, y_mm: NDArray[np.float64], frame: float) -> NDArray[np.float64]:
        """Half the opening at y (at rest); 0 where the blade has not been."""
        lens = np.sqrt(np.clip(1 - (y_mm / CUT_HALF_LENGTH_MM) ** 2, 0, 1))
        behind = smoothstep(self.blade_mm(frame) - y_mm, 0.0, CUT_GAPE_MM).astype(np.float64)
        half_width: NDArray[np.float64] = CUT_HALF_WIDTH_MM * lens * behind
        return half_width

    def __call__(self, rest_mm: Points, frame: float) -> Points:
        side: NDArray[np.float64] = np.sign(from_cut_mm(rest_mm))
        return self.move(rest_mm, frame, side)

    def move(self, rest_mm: Points, frame: float, side: NDArray[np.float64] | float) -> Points:
        distance = np.abs(from_cut_mm(rest_mm))
        half_width = self.half_width_mm(rest_mm[..., 1], frame)
        moved = Breathing(self.period_frames, strength=0.35)(rest_mm, frame)
        moved[..., 0] += side * half_width * np.exp(-distance / CUT_REACH_MM)
        curl = np.exp(-((distance / CUT_LIP_REACH_MM) ** 2)) * half_width / CUT_HALF_WIDTH_MM
        moved[..., 2] -= CUT_LIP_MM * curl
        return moved

    def groove(self, left_lip: Points, right_lip: Points, frame: float, across: NDArray[np.float64]) -> Points:
        """The deeper tissue between the lips, [rows, columns, 3].

        Args:
            left_lip, right_lip: [rows, 3] at rest.
            across: [columns] from -1 at the left lip to +1 at the right lip.

        Where the cut is closed, the groove is folded to a line and invisible.
        """
        left, right = self.move(left_lip, frame, -1.0), self.move(right_lip, frame, 1.0)
        share = ((across + 1) / 2)[None, :, None]
        moved = left[:, None] * (1 - share) + right[:, None] * share
        half_width = self.half_width_mm(left_lip[:, 1], frame)
        depth = np.minimum(CUT_DEPTH_PER_WIDTH * half_width, MAX_CUT_DEPTH_MM)
        moved[..., 2] += depth[:, None] * (1 - np.abs(across) ** 5)
        return moved


def from_cut_mm(rest_mm: Points) -> NDArray[np.float64]:
    """Signed distance along x of points at rest from the cut's line; negative to its left."""
    along: NDArray[np.float64] = rest_mm[..., 0] - CUT_SLANT * rest_mm[..., 1]
    return along


def make_motion(name: str, period_frames: float) -> TissueMotion:
    makers = {"breathing": Breathing, "pull": Pull, "cut": Cut}
    return makers[name](period_frames) if name in makers else Still()
