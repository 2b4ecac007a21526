"""Gram matrices of the links, and the normal equations of cameras and tissue motion that follow from them.

A link's residuals are linear in the twist of its cameras, applied left of world_from_camera, and in the field's
coefficients. Its Gram matrix holds all products of those columns and the residual. It gives the normal equations for
any time courses without another pass over the matches.

Symbols: K frames, L links, M matches, F polynomials, S courses; G = 7 + 3 F columns: twist, coefficients, residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from intrasplat.poses.field import DeformationField, waves
from intrasplat.poses.links import FrameLink
from intrasplat.poses.rigid import Reals, StereoCamera, inverse, weighted_median

INDEPENDENT, NOISE_PX = 0.05, 0.35
"""Share of matches that count as independent, because errors of flow and depth are correlated over some pixels; noise
of a match."""
MIN_SCALE_PX = 0.5
"""Minimum robust scale: the residual at which a match has a quarter of its weight."""
FIXED, DAMPED = 1e9, 1e-6
"""Added to the diagonal of the normal equations: fixes the first camera, which is the world, and damps all others."""


@dataclass(frozen=True, eq=False)
class LinkGram:
    """A link's Gram matrix [G, G], the lengths of its residuals [M] in px, and their robust weights [M]."""

    gram: Reals
    residual_px: Reals
    weight: Reals


def link_gram(
    camera: StereoCamera,
    link: FrameLink,
    poses: tuple[Reals, Reals],
    field: DeformationField,
    change: Reals,
    scale_px: float,
    rigidity: Reals | None,
) -> LinkGram:
    """A link's Gram matrix at the current poses [4, 4] of its frames and the current field.

    Derivatives are taken at the match's position in the second frame. The residual contains the first frame's depth;
    its noise is independent of the second frame's, so that noise does not bias the cameras towards each other.

    Args:
        change: [S] change of the courses from the first frame to the second.
        scale_px: maximum residual at which a match has a quarter of its weight; twice the median residual if less.
        rigidity: weight of each cell of the first frame, or None.
    """
    from_a, from_b = poses
    world = camera.points_mm(link.before) @ from_a[:3, :3].T + from_a[:3, 3]
    back = inverse(from_b)
    moved = world + field.displacement(world, change)
    off = camera.seen(moved @ back[:3, :3].T + back[:3, 3]) - link.after
    squared = np.square(off).sum(1)
    limit = np.clip(2 * np.sqrt(weighted_median(squared, link.trust)), MIN_SCALE_PX, scale_px)
    weight = 1 / np.square(1 + squared / limit**2)
    total = link.trust * weight * (INDEPENDENT / NOISE_PX**2)
    if rigidity is not None:
        total = total * rigidity[link.cells]
    there = camera.points_mm(link.after)
    world = there @ from_b[:3, :3].T + from_b[:3, 3]
    functions = np.concatenate([field.powers(world).T, world[:, 2:].T])  # [F + 1, M]
    slopes = camera.slopes_by_point(there).transpose(1, 2, 0)
    (across, down), (ax, ay, az) = (slopes[0, 0], slopes[1, 1]), slopes[:, 2]
    squares = total * np.stack([across * across, across * ax, down * down, down * ay, ax * ax + ay * ay + az * az])
    pulls = total * np.stack([across * off[:, 0], down * off[:, 1], (slopes[:, 2] * off.T).sum(0)])
    size = len(functions)
    products = ((squares[:, None] * functions).reshape(5 * size, len(there)) @ functions.T).reshape(5, size, size)
    inner = np.zeros((size, size, 3, 3))  # in the second camera's axes
    for product, (one, two) in zip(products, ((0, 0), (0, 2), (1, 1), (1, 2), (2, 2)), strict=True):
        inner[:, :, one, two] = inner[:, :, two, one] = product
    turned = from_b[:3, :3] @ inner @ from_b[:3, :3].T
    gram = np.empty((3 * size + 1, 3 * size + 1))
    gram[:-1, :-1] = turned.transpose(0, 2, 1, 3).reshape(3 * size, 3 * size)
    gram[:-1, -1] = gram[-1, :-1] = (functions @ pulls.T @ from_b[:3, :3].T).ravel()
    gram[-1, -1] = (total * squared).sum()
    columns = _columns(field)
    return LinkGram(columns.T @ gram @ columns, np.sqrt(squared), weight)


def _columns(field: DeformationField) -> Reals:
    """[3 F + 4, G] the columns as combinations of the polynomials and z, each along three axes, and the residual."""
    count = field.weight.shape[1]  # 3 F
    columns = np.zeros((count + 4, 7 + count))
    columns[:count, 6:-1] = np.eye(count)
    columns[-1, -1] = 1
    columns[:3, :3] = np.eye(3)  # the polynomial 1
    coordinates = np.zeros((3, count // 3 + 1))  # x, y, z in the polynomials 1, y, x, ... and z
    coordinates[0, [0, 2]] = field.middle[0], field.half[0]
    coordinates[1, [0, 1]] = field.middle[1], field.half[1]
    coordinates[2, -1] = 1
    for axis in range(3):  # a rotation w moves p by w x p
        one, two = (axis + 1) % 3, (axis + 2) % 3
        columns[two : count + 3 : 3, 3 + axis] += coordinates[one]
        columns[one : count + 3 : 3, 3 + axis] -= coordinates[two]
    return columns


@dataclass(frozen=True, eq=False)
class Grams:
    """The Gram matrices of all links.

    gram       [L, G, G]
    incidence  [L, K]  1 at the link's first frame, -1 at its second
    frames     [K]     indices in the clip
    """

    gram: Reals
    incidence: Reals
    frames: Reals

    def solved(self, field: DeformationField) -> tuple[Reals, Reals]:
        """Steps for fixed courses: twists [K, 6] of the cameras and changes [S, 3 F] of the field's weights."""
        factor, right = cho_factor(self._twists()), self._residuals()
        if not len(field.weight):
            return cho_solve(factor, right).reshape(-1, 6), np.zeros_like(field.weight)
        bends, mixed, bent = self._bends(field.courses)
        ridge = np.tile(field.ridge, len(field.weight))
        through = cho_solve(factor, mixed)
        normal = bends + np.diag(ridge) - mixed.T @ through
        bend = np.linalg.solve(normal, bent - ridge * field.weight.ravel() - through.T @ right)
        return (cho_solve(factor, right) - through @ bend).reshape(-1, 6), bend.reshape(field.weight.shape)

    def followed(self, field: DeformationField) -> tuple[Reals, Reals]:
        """Steps for fixed weights: twists [K, 6] of the cameras and changes [K, S] of the field's courses."""
        kinds, count = len(field.weight), len(self.frames)
        columns = np.zeros((7 + kinds, self.gram.shape[1]))
        columns[:6, :6], columns[6:-1, 6:-1], columns[-1, -1] = np.eye(6), -field.weight, 1
        gram = columns @ self.gram @ columns.T
        size = 6 + kinds
        normal = self._by_frame(gram[:, :-1, :-1])
        right = -np.einsum("lk,li->ki", self.incidence, gram[:, :-1, -1])
        usual = np.full((count, size), DAMPED)
        usual[:, 6:] = 1.0  # the size of a course
        right[:, 6:] -= field.courses
        normal += np.diag(usual.ravel())
        normal[:6, :6] += FIXED * np.eye(6)
        found = np.linalg.solve(normal, right.ravel()).reshape(count, size)
        return found[:, :6], found[:, 6:]

    def covariance(self, field: DeformationField) -> Reals:
        """[6 K, 6 K] covariance of the cameras' twists. The field is marginalised, without rigid motions of all tissue.

        Links cannot separate those motions from the cameras'; common_motion.py does.
        """
        normal, kinds = self._twists(), len(field.weight)
        if kinds:
            bends, mixed, _ = self._bends(field.courses)
            even, _ = np.linalg.qr(field.rigid, mode="complete")
            bent = np.kron(np.eye(kinds), even[:, field.rigid.shape[1] :])
            mixed = mixed @ bent
            ridge = np.diag(np.tile(field.ridge, kinds))
            normal -= mixed @ np.linalg.solve(bent.T @ (bends + ridge) @ bent, mixed.T)
        return np.asarray(np.linalg.inv(normal))

    def bent_mm(self, field: DeformationField, depth_mm: float) -> float:
        """Root mean square over the links of the deformation that the field does not explain, mm."""
        squares = []
        for gram in self.gram:
            normal = gram[:-1, :-1] + np.diag(np.concatenate([np.full(6, DAMPED), field.ridge]))
            left = replace(field, weight=np.linalg.solve(normal, -gram[:-1, -1])[None, 6:])
            squares.append(left.sizes_mm(depth_mm)[0] ** 2)
        return float(np.sqrt(np.mean(squares)))

    def without(self, field: DeformationField) -> Grams:
        """The Gram matrices without the field."""
        return self.shifted(-(self.change(field) @ field.weight))

    def with_weights(self, field: DeformationField, added: Reals) -> Grams:
        """The Gram matrices after a change [S, 3 F] of the field's weights."""
        return self.shifted(self.change(field) @ added)

    def shifted(self, moved: Reals) -> Grams:
        """The Gram matrices after the tissue of each link was moved by coefficients [L, 3 F]."""
        lift = np.tile(np.eye(self.gram.shape[1]), (len(moved), 1, 1))
        lift[:, -1, 6:-1] = moved
        return replace(self, gram=lift @ self.gram @ lift.transpose(0, 2, 1))

    def change(self, field: DeformationField) -> Reals:
        """[L, S] change of the field's courses from each link's first frame to its second."""
        return -(self.incidence @ field.courses)

    def unexplained(self) -> float:
        """Sum of squared residuals at the best cameras."""
        right = self._residuals()
        return float(self.gram[:, -1, -1].sum() - right @ cho_solve(cho_factor(self._twists()), right))

    def explained(self, field: DeformationField, periods: Sequence[float]) -> list[float]:
        """How much a field of each period lowers that sum. Call it on Gram matrices without a field."""
        factor, right = cho_factor(self._twists()), self._residuals()
        found = []
        for period in periods:
            courses = waves(self.frames, period)
            bends, mixed, bent = self._bends(courses)
            through = cho_solve(factor, mixed)
            bent = bent - through.T @ right
            ridge = np.diag(np.tile(field.ridge, courses.shape[1]))
            found.append(float(bent @ np.linalg.solve(bends + ridge - mixed.T @ through, bent)))
        return found

    def _twists(self) -> Reals:
        """[6 K, 6 K] normal matrix of the twists."""
        normal = self._by_frame(self.gram[:, :6, :6]) + DAMPED * np.eye(6 * len(self.frames))
        normal[:6, :6] += FIXED * np.eye(6)
        return normal

    def _by_frame(self, gram: Reals) -> Reals:
        """[n K, n K] normal matrix of n unknowns per frame, whose differences the links [L, n, n] measure."""
        count, size = len(self.frames), gram.shape[1]
        blocks = np.zeros((count, count, size, size))
        first, second = self.incidence.argmax(1), self.incidence.argmin(1)
        for one, two, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
            np.add.at(blocks, (one, two), sign * gram)
        return np.asarray(blocks.transpose(0, 2, 1, 3).reshape(count * size, -1))

    def _residuals(self) -> Reals:
        """[6 K] right side of the normal equations of the twists."""
        return np.asarray(-np.einsum("lk,li->ki", self.incidence, self.gram[:, :6, -1]).ravel())

    def _bends(self, courses: Reals) -> tuple[Reals, Reals, Reals]:
        """For the weights [S 3 F]: normal matrix, its block [6 K, S 3 F] with the twists, right side."""
        change = -(self.incidence @ courses)
        links, kinds = change.shape
        bends = self.gram.shape[1] - 7
        squares = (change[:, :, None] * change[:, None]).reshape(links, -1)
        normal = (squares.T @ self.gram[:, 6:-1, 6:-1].reshape(links, -1)).reshape(kinds, kinds, bends, bends)
        crossed = (self.gram[:, :6, None, 6:-1] * change[:, None, :, None]).reshape(links, -1)
        mixed = (self.incidence.T @ crossed).reshape(-1, kinds * bends)
        right = -(change.T @ self.gram[:, 6:-1, -1]).ravel()
        return normal.transpose(0, 2, 1, 3).reshape(kinds * bends, -1), mixed, right
