"""Cross-validation of the number of bases: bases fitted to some training frames predict the tracks in the others.

Symbols: T training frames; K of them tracked, k of these validation frames; n sampled cells of the grid, B bases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera, unproject
from intrasplat.clip import DepthClip
from intrasplat.motion.least_squares import fit_series
from intrasplat.motion.lifted import cell_means
from intrasplat.motion.tracks import Tracks

Reals = NDArray[np.float64]
BasisValues = Callable[[int, Sequence[float], Sequence[float]], Reals]
"""(B, training times, times) -> [len(times), B] values of B bases that are placed for the training times."""

CELLS = 1000
"""Number of tracks, over all keyframes, on which bases are tried."""
VALIDATE_EVERY, FIRST_VALIDATED = 4, 2
"""Every fourth training frame, from the third on, is a validation frame; bases are fitted to the others."""
MIN_TRACK_CONFIDENCE = 0.3
"""Minimum mean confidence of a track that is used."""


@dataclass(frozen=True)
class FitError:
    """Mean squared error of a number of bases in validation frames, in squared grey levels per channel.

    motion  error of the displacement times the picture's gradient where the track starts
    light   error of the change of colour along the track
    """

    motion: float
    light: float

    @property
    def total(self) -> float:
        return self.motion + self.light


@dataclass(frozen=True, eq=False)
class Trial:
    """A sample of the trusted tracks, evenly spread over them, and which training frames are validation frames.

    reference                   the keyframe in which the tracks start
    followed         [K]        indices of the tracked frames among the training frames
    places           [n]        flat pixel indices in the reference
    world_mm         [n, 3]     start positions of the tracks
    displacement_mm  [K, n, 3]
    colour           [K, n, 3]  change, in grey levels
    confidence       [K, n]
    tried            [T]        True for validation frames
    basis_values                values of the bases that the motion would have
    """

    clip: DepthClip
    train: Sequence[int]
    reference: int
    followed: NDArray[np.intp]
    step_px: int
    places: NDArray[np.intp]
    world_mm: Reals
    displacement_mm: Reals
    colour: Reals
    confidence: Reals
    tried: NDArray[np.bool_]
    basis_values: BasisValues

    @classmethod
    def of(
        cls, tracks: Tracks, clip: DepthClip, train: Sequence[int], basis_values: BasisValues, cells: int = CELLS
    ) -> Trial:
        """The trial for the clip's training frames `train`, with at most `cells` sampled cells."""
        _, height, width = tracks.confidence.shape
        step, reference = tracks.step_px, train[tracks.reference]
        rows, columns = np.divmod(np.arange(height * width), width)
        places = (rows * step + step // 2) * clip.intrinsics.width + columns * step + step // 2
        depth_mm = clip.depth_mm[reference].reshape(-1)[places]
        trusted = np.flatnonzero((tracks.confidence.mean(0).reshape(-1) > MIN_TRACK_CONFIDENCE) & (depth_mm > 0))
        some = trusted[np.linspace(0, len(trusted) - 1, min(cells, len(trusted))).round().astype(np.intp)]
        displacement_mm, colour, confidence = (values.astype(np.float64) for values in tracks.at(some))
        tried = np.zeros(len(train), np.bool_)
        tried[FIRST_VALIDATED::VALIDATE_EVERY] = True
        return cls(
            clip=clip,
            train=train,
            reference=reference,
            followed=tracks.followed,
            step_px=step,
            places=places[some],
            world_mm=unproject(places[some], depth_mm[some], clip.intrinsics, clip.world_from_camera[reference]),
            displacement_mm=displacement_mm,
            colour=255 * colour,
            confidence=confidence,
            tried=tried,
            basis_values=basis_values,
        )

    @property
    def validation(self) -> NDArray[np.bool_]:
        """[K] True for validation frames."""
        return np.asarray(self.tried[self.followed])

    @property
    def weight(self) -> float:
        """Total weight of the tracks in the validation frames."""
        return float(self.confidence[self.validation].sum())

    def error(self, bases: int) -> FitError:
        """The error of this number of bases in the validation frames."""
        displacement_mm, colour = self._predicted(bases)
        off_mm = self.displacement_mm[self.validation] - displacement_mm
        motion = (self._grey_per_mm() @ off_mm[..., None])[..., 0]
        light = self.colour[self.validation] - colour
        return FitError(self._mean_square(motion), self._mean_square(light))

    def picture_error(self, bases: int) -> float:
        """Mean squared difference per channel, in squared grey levels, of picture and prediction in validation frames.

        The picture is read at the track positions that this number of bases predicts. The prediction is the colour at
        the start of the track plus the predicted change.
        """
        displacement_mm, colour = self._predicted(bases)
        k, start = self.clip.intrinsics, self.clip.rgb[self.reference].reshape(-1, 3)[self.places]
        expected, shown = start + colour, np.empty_like(colour)
        for place, frame in enumerate(np.asarray(self.train)[self.followed][self.validation]):
            pose = self.clip.world_from_camera[frame]
            x, y, z = to_camera(self.world_mm + displacement_mm[place], pose).T
            column, row = (k.fx * x / z + k.cx - 0.5)[:, None], (k.fy * y / z + k.cy - 0.5)[:, None]
            image, places = self.clip.rgb[frame].astype(np.float32), (column.astype(np.float32), row.astype(np.float32))
            shown[place] = cv2.remap(image, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
            self.clip.let_go(frame)
        return self._mean_square(shown - expected)

    def _predicted(self, bases: int) -> tuple[Reals, Reals]:
        """Displacement (mm) and change of colour (grey levels) [k, n, 3] of the tracks in the validation frames.

        The bases are fitted to the other frames as fit_tracks does; their number shrinks with that of the frames.
        """
        times = np.array([float(self.clip.t[index]) for index in self.train])
        fitted = max(min(2, bases), round((~self.tried).mean() * bases))
        basis = self.basis_values(fitted, times[~self.tried].tolist(), times.tolist())[self.followed]
        kept = ~self.validation
        series = np.concatenate([self.displacement_mm, self.colour], axis=2)
        weights = fit_series(series[kept], self.confidence[kept], basis[kept])
        predicted = (basis[self.validation] @ weights).transpose(1, 0, 2)
        return predicted[..., :3], predicted[..., 3:]

    def _mean_square(self, off: Reals) -> float:
        """Mean square of errors [k, n, 3] in the validation frames, weighted by the tracks' confidence."""
        weight = self.confidence[self.validation]
        return float((np.square(off).mean(-1) * weight).sum() / max(weight.sum(), 1e-9))

    def _grey_per_mm(self) -> Reals:
        """Picture gradient at the track starts [n, 3 channels, 3 axes], grey levels per mm of tissue motion."""
        k, pose = self.clip.intrinsics, self.clip.world_from_camera[self.reference]
        across, along, z = to_camera(self.world_mm, pose).T[..., None]
        right, down, away = pose[:3, :3].T  # camera axes in the world
        px_per_mm = np.stack(
            [k.fx / z * (right - across / z * away), k.fy / z * (down - along / z * away)], axis=1
        )  # [n, 2, 3]
        rows, columns = np.divmod(self.places, k.width)
        slopes = _slopes(self.clip.rgb[self.reference], self.step_px)
        return np.asarray(slopes[rows // self.step_px, columns // self.step_px] @ px_per_mm)


def mean_error(trials: Sequence[Trial], bases: int) -> FitError:
    """The error of this number of bases in the validation frames, over the tracks of all trials."""
    errors, shares = [trial.error(bases) for trial in trials], _shares(trials)
    return FitError(
        sum(share * each.motion for share, each in zip(shares, errors, strict=True)),
        sum(share * each.light for share, each in zip(shares, errors, strict=True)),
    )


def mean_picture_error(trials: Sequence[Trial], bases: int) -> float:
    """Trial.picture_error over the tracks of all trials."""
    return sum(share * trial.picture_error(bases) for share, trial in zip(_shares(trials), trials, strict=True))


def _shares(trials: Sequence[Trial]) -> list[float]:
    """Each trial's share of the total weight."""
    total = sum(trial.weight for trial in trials)
    return [trial.weight / total if total else 1 / len(trials) for trial in trials]


def _slopes(rgb: NDArray[np.uint8], step: int) -> Reals:
    """Picture gradient [h, w, 3, 2], grey levels per clip pixel right and down, on the tracks' grid of h w cells."""
    small = cell_means(rgb, step).astype(np.float32)
    slopes = [cv2.Scharr(small, cv2.CV_32F, int(axis == 0), int(axis == 1)) / (32 * step) for axis in range(2)]
    return np.stack(slopes, axis=-1).astype(np.float64)
