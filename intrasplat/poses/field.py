"""A smooth motion of the tissue: u(x, t) = sum_s A_s phi(x) h_s(t), polynomials phi of position, time courses h_s.

The rigid part of u may be the camera's motion as well (intrasplat/poses/common_motion.py).

Symbols: K frames, M positions, F polynomials, S time courses. Lengths in mm, in the world frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.poses.rigid import Reals, cross

HARMONICS = 2
USUAL_MM, SMOOTH = 6.0, 1.4
"""Prior standard deviation of a coefficient of degree d: USUAL_MM / SMOOTH^d."""
SAMPLED = 5
"""Positions along each axis at which the size of a deformation is measured."""


@dataclass(frozen=True, eq=False)
class DeformationField:
    """A motion of the tissue.

    degree   of the polynomials in x and y
    middle, half  [2] mm: the middle and half the extent of the visible tissue; positions are scaled by them
    weight   [S, 3 F] the coefficients A
    courses  [K, S] in any unit
    period   in frames, of courses that are sines and cosines or were fitted from them; None: there is no motion
    """

    degree: int
    middle: Reals
    half: Reals
    weight: Reals
    courses: Reals
    period: float | None = None

    @classmethod
    def at_rest(cls, degree: int, middle: Reals, half: Reals, frames: int) -> DeformationField:
        """No motion in so many frames."""
        return cls(degree, middle, half, np.zeros((0, 3 * powers_of(degree))), np.zeros((frames, 0)))

    @property
    def degrees(self) -> NDArray[np.intp]:
        """[3 F] the degree of each coefficient."""
        return np.asarray(np.repeat([total for total in range(self.degree + 1) for _ in range(total + 1)], 3))

    @property
    def ridge(self) -> Reals:
        """[3 F] prior inverse variance of each coefficient."""
        return np.asarray(np.square(SMOOTH**self.degrees / USUAL_MM))

    @property
    def rigid(self) -> Reals:
        """[3 F, 6] the coefficients of the six rigid motions of flat tissue: along the axes, and about them."""
        found = np.zeros((3 * powers_of(self.degree), 6))
        found[:3, :3] = np.eye(3)
        for axis, turn in enumerate(np.eye(3)):  # the polynomials 1, y, x
            found[3:6, 3 + axis] = np.cross(turn, [0, self.half[1], 0])
            found[6:9, 3 + axis] = np.cross(turn, [self.half[0], 0, 0])
        return found

    def powers(self, places_mm: Reals) -> Reals:
        """[M, F] the polynomials: 1, y, x, y^2, x y, x^2, ..."""
        x, y = ((places_mm[:, :2] - self.middle) / self.half).T
        all_of = [(i, total - i) for total in range(self.degree + 1) for i in range(total + 1)]
        across, down = np.ones((2, self.degree + 1, len(places_mm)))
        for power in range(1, self.degree + 1):
            across[power], down[power] = across[power - 1] * x, down[power - 1] * y
        return np.stack([across[i] * down[j] for i, j in all_of]).T

    def displacement(self, places_mm: Reals, change: Reals) -> Reals:
        """[M, 3] mm by which tissue moves while the courses change by [S]."""
        if not len(change):
            return np.zeros_like(places_mm)
        return np.asarray(self.powers(places_mm) @ (change @ self.weight).reshape(-1, 3))

    def course_at(self, frame: float, frames: Sequence[int]) -> Reals:
        """[S] the courses at any frame. frames: the K fitted frames."""
        return np.array([np.interp(frame, frames, course) for course in self.courses.T])

    def sizes_mm(self, depth_mm: float) -> Reals:
        """[S] root mean square of the deformation for a course of 1, without its rigid part."""
        sides = np.linspace(-0.8, 0.8, SAMPLED)
        flat = np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2) * self.half + self.middle
        places = np.concatenate([flat, np.full((len(flat), 1), depth_mm)], axis=1)
        turns = np.stack([-cross(place) for place in places - places.mean(0)])
        rigid = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), turns], axis=2).reshape(-1, 6)
        moved = np.array([self.displacement(places, course).ravel() for course in np.eye(len(self.weight))])
        moved = moved.reshape(len(self.weight), len(rigid))
        bent = moved.T - rigid @ np.linalg.lstsq(rigid, moved.T, rcond=None)[0]
        return np.asarray(np.sqrt(np.square(bent).sum(0) / len(places)))


def powers_of(degree: int) -> int:
    """F, the number of polynomials up to a degree."""
    return (degree + 1) * (degree + 2) // 2


def waves(frames: Reals, period: float) -> Reals:
    """[K, 2 HARMONICS] cosines and sines of a period, both in frames."""
    angle = 2 * np.pi * np.asarray(frames, np.float64)[:, None] * np.arange(1, HARMONICS + 1) / period
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
