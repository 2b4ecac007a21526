"""Lazy rectification: a stereo clip whose matching points lie on the same rows.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.recorded_masks import Rectification
from intrasplat.clip.types import PairSource, RgbFrame, StereoClip
from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD, check_calibration
from intrasplat.intake.calibration.fit import MAX_PIXEL_SKEW
from intrasplat.intake.calibration.types import RawCalibration, RawEye, RectifiedCalibration, StereoCalibration
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.notices import Notice, NoticeCode

OPENCV_PIXEL_CENTRE = 0.5  # pixel centres are whole numbers in OpenCV, at +0.5 in this project (docs/conventions.md)
WARN_ZOOM, MAX_ZOOM = 1.2, 2.0  # of the focal length; a sound endoscope calibration stays below 1.1

USUAL_VIEW_DEG = 35.0, 95.0
"""Usual horizontal field of view of an endoscope. 59 is typical: twice or half its focal length lies outside."""

GRID_POINTS = 17  # per side of the grid on which the row shift by rectification is measured

Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]  # OpenCV's fixed-point maps: source pixel, index of its fraction


@dataclass(frozen=True)
class RectifiedClip:
    """A stereo clip whose rows match: disparity_px = fx * baseline_mm / depth_mm + disparity_offset_px.

    pairs yields rectified (left, right) RGB uint8 frames, remapped on demand. tissue is [T, H, W] bool in the pixels of
    the rectified left eye (a read-only view if no masks were given), False where the rectified image extends beyond the
    recorded one. tissue_right is the same for the right eye, None if no masks show it. intrinsics are the left eye's.
    rectification has the left eye's mapping; None: the frames are unchanged. damaged: as in the recorded clip.
    given_fields: those of the recorded clip, in rectified pixels.

    equal_rows_px is y_right - y_left, in these frames, of points on equal rows of the recorded frames. If frames that
    were rectified already are rectified again, about this row shift is measured.
    """

    frame_count: int
    intrinsics: Intrinsics
    baseline_mm: float
    disparity_offset_px: float
    pairs: PairSource
    tissue: NDArray[np.bool_]
    frame_times_s: NDArray[np.float64]
    assumptions: tuple[Notice, ...] = ()
    warnings: tuple[Notice, ...] = ()
    equal_rows_px: float = 0.0
    tissue_right: NDArray[np.bool_] | None = None
    rectification: Rectification | None = None
    damaged: tuple[int, ...] = ()
    given_fields: tuple[NDArray[np.bool_], ...] = ()


def rectify(clip: StereoClip, calibration: StereoCalibration) -> RectifiedClip:
    """The clip with matching points of both eyes on the same rows, rectified frame by frame on demand.

    A "rectified" calibration passes the frames through. For "raw" ones the maps are computed once
    (cv2.stereoRectify with alpha 0: no pixel of the result lies outside the recording, as far as one zoom allows); the
    eyes keep their own principal points, whose distance becomes disparity_offset_px. Adding 0.5 to cx and cy converts
    OpenCV's pixel centres to this project's.

    Raises:
        InputError: the calibration is for another image size, or its eyes are not side by side.
    """
    if (calibration.width, calibration.height) != (clip.width, clip.height):
        raise InputError(
            FIELD,
            f"it is for {calibration.width}x{calibration.height} pixels an eye, "
            f"the clip has {clip.width}x{clip.height}.",
            "Read it with load_calibration for the clip's size.",
        )
    check_calibration(calibration)
    if isinstance(calibration, RectifiedCalibration):
        return _pass_through(clip, calibration)
    return _remapped(clip, calibration)


@dataclass(frozen=True)
class _RemappedPairs:
    """Rectified pairs of a source, remapped one by one."""

    source: PairSource
    left_maps: Maps
    right_maps: Maps

    def __call__(self) -> Iterator[tuple[RgbFrame, RgbFrame]]:
        for left, right in self.source():
            yield (
                cv2.remap(left, *self.left_maps, cv2.INTER_LINEAR),
                cv2.remap(right, *self.right_maps, cv2.INTER_LINEAR),
            )


def _pass_through(clip: StereoClip, calibration: RectifiedCalibration) -> RectifiedClip:
    c = calibration
    return RectifiedClip(
        frame_count=clip.frame_count,
        intrinsics=Intrinsics(width=c.width, height=c.height, fx=c.fx_px, fy=c.fy_px, cx=c.cx_px, cy=c.cy_px),
        baseline_mm=c.baseline_mm,
        disparity_offset_px=c.disparity_offset_px,
        pairs=clip.pairs,
        tissue=_all_tissue(clip) if clip.tissue is None else clip.tissue,
        frame_times_s=clip.frame_times_s,
        assumptions=_assumptions(clip, c, "frames: rectified already, as the calibration says"),
        warnings=clip.warnings + _scale_warning(c) + _view_warning(c.fx_px, c.width),
        tissue_right=clip.tissue_right,
        damaged=clip.damaged,
        given_fields=clip.given_fields,
    )


def _remapped(clip: StereoClip, calibration: RawCalibration) -> RectifiedClip:
    size = (clip.width, clip.height)
    cameras = [(_matrix(eye), np.array(eye.distortion)) for eye in (calibration.left, calibration.right)]
    left_r, right_r, left_p, right_p = _rectification(calibration)
    left_maps: Maps = cv2.initUndistortRectifyMap(*cameras[0], left_r, left_p, size, cv2.CV_16SC2)
    right_maps: Maps = cv2.initUndistortRectifyMap(*cameras[1], right_r, right_p, size, cv2.CV_16SC2)
    return RectifiedClip(
        frame_count=clip.frame_count,
        intrinsics=Intrinsics(
            width=clip.width,
            height=clip.height,
            fx=float(left_p[0, 0]),
            fy=float(left_p[1, 1]),
            cx=float(left_p[0, 2]) + OPENCV_PIXEL_CENTRE,
            cy=float(left_p[1, 2]) + OPENCV_PIXEL_CENTRE,
        ),
        baseline_mm=float(-right_p[0, 3] / right_p[0, 0]),
        disparity_offset_px=float(left_p[0, 2] - right_p[0, 2]),
        pairs=_RemappedPairs(clip.pairs, left_maps, right_maps),
        tissue=_all_tissue(clip) if clip.tissue is None else _warp_tissue(clip.tissue, left_maps),
        frame_times_s=clip.frame_times_s,
        assumptions=_assumptions(clip, calibration, "frames: as recorded, rectified by the calibration"),
        warnings=clip.warnings
        + _scale_warning(calibration)
        + _view_warning(calibration.left.fx_px, clip.width)
        + _zoom_warning(float(left_p[0, 0]) / calibration.left.fx_px),
        equal_rows_px=float(
            np.median(_rows(size, *cameras[1], right_r, right_p) - _rows(size, *cameras[0], left_r, left_p))
        ),
        tissue_right=None if clip.tissue_right is None else _warp_tissue(clip.tissue_right, right_maps),
        rectification=Rectification(
            camera=_rows_of(cameras[0][0]),
            distortion=tuple(cameras[0][1].tolist()),
            rotation=_rows_of(left_r),
            projection=_rows_of(left_p),
        ),
        damaged=clip.damaged,
        given_fields=_warp_fields(clip.given_fields, left_maps, right_maps),
    )


def _rectification(
    calibration: RawCalibration,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [3, 3] and projections [3, 4] of left and right.

    stereoRectify gives square pixels. Those of a squeezed eye are rectified as a whole eye's and squeezed again.
    """
    squeeze = calibration.left.fx_px / calibration.left.fy_px
    squeeze = squeeze if abs(squeeze - 1) > MAX_PIXEL_SKEW else 1.0
    width, height = max(1, round(calibration.width / squeeze)), calibration.height
    whole = calibration if squeeze == 1 else calibration.resized(width, height)
    cameras = [(_matrix(eye), np.array(eye.distortion)) for eye in (whole.left, whole.right)]
    rotation, translation = np.array(whole.right_from_left_rotation), np.array(whole.right_from_left_translation_mm)
    left_r, right_r, left_p, right_p = cv2.stereoRectify(
        *cameras[0], *cameras[1], (width, height), rotation, translation, flags=0, alpha=0.0
    )[:4]
    if squeeze != 1:
        sx = calibration.width / width
        for projection in (left_p, right_p):
            projection[0] *= sx
            projection[0, 2] += OPENCV_PIXEL_CENTRE * (sx - 1)
    return left_r, right_r, left_p, right_p


def _rows(
    size: tuple[int, int],
    k: NDArray[np.float64],
    distortion: NDArray[np.float64],
    rotation: NDArray[np.float64],
    projection: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The rectified rows of a coarse grid of recorded pixels, [M]."""
    x, y = np.meshgrid(*(np.linspace(0, side - 1, GRID_POINTS) for side in size))
    recorded = np.stack([x.ravel(), y.ravel()], axis=1)
    rows: NDArray[np.float64] = cv2.undistortPoints(recorded, k, distortion, R=rotation, P=projection)[:, 0, 1]
    return rows


def _matrix(eye: RawEye) -> NDArray[np.float64]:
    return np.array([[eye.fx_px, 0.0, eye.cx_px], [0.0, eye.fy_px, eye.cy_px], [0.0, 0.0, 1.0]])


def _rows_of(matrix: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def _warp_tissue(tissue: NDArray[np.bool_], maps: Maps) -> NDArray[np.bool_]:
    """Tissue in rectified pixels, nearest neighbour; False beyond the recorded image."""
    warped = mapped_zeros(tissue.shape, np.bool_)
    for i, mask in enumerate(tissue):
        warped[i] = cv2.remap(mask.astype(np.uint8), *maps, cv2.INTER_NEAREST, borderValue=0) > 0
        let_go(warped[i])
        let_go(mask)
    return warped


def _warp_fields(fields: tuple[NDArray[np.bool_], ...], *maps: Maps) -> tuple[NDArray[np.bool_], ...]:
    """The fields of view that were given, in rectified pixels. InputError if nothing is left of one."""
    warped = tuple(_warp_tissue(field[None], each)[0] for field, each in zip(fields, maps, strict=False))
    if not all(field.any() for field in warped):
        problem = "all that it marks lies where rectification crops the pictures."
        raise InputError("fov_mask", problem, "Mark the part of the recorded picture that shows the scene.")
    return warped


def _all_tissue(clip: StereoClip) -> NDArray[np.bool_]:
    """True [T, H, W], as a view without memory: alpha 0 leaves no pixel beyond the recording."""
    return np.broadcast_to(np.True_, (clip.frame_count, clip.height, clip.width))


def _assumptions(clip: StereoClip, calibration: StereoCalibration, done: str) -> tuple[Notice, ...]:
    own = (Notice.info(NoticeCode.CALIBRATION, text) for text in calibration.assumptions)
    return (*clip.assumptions, *own, Notice.info(NoticeCode.RECTIFICATION, done))


def _scale_warning(calibration: StereoCalibration) -> tuple[Notice, ...]:
    """The warning about a calibration for frames of another size."""
    if calibration.scaled_from is None:
        return ()
    width, height = calibration.scaled_from
    text = (
        f"the calibration is for {width}x{height} pixels an eye and was scaled to the clip's {calibration.width}x"
        f"{calibration.height}: if its numbers are of another size than it names, or frames were cropped, every "
        "distance is wrong"
    )
    return (Notice.warning(NoticeCode.CALIBRATION_SCALED, text),)


def _view_warning(fx_px: float, width: int) -> tuple[Notice, ...]:
    """The warning about an unusual field of view."""
    view_deg = math.degrees(2 * math.atan(width / (2 * fx_px)))
    low_deg, high_deg = USUAL_VIEW_DEG
    if low_deg <= view_deg <= high_deg:
        return ()
    text = (
        f"by the calibration the picture is {view_deg:.0f} degrees wide, and endoscopes show {low_deg:.0f} to "
        f"{high_deg:.0f}: check the image size and the focal length that it names, on which every distance depends"
    )
    return (Notice.warning(NoticeCode.FIELD_OF_VIEW_UNUSUAL, text),)


def _zoom_warning(zoom: float) -> tuple[Notice, ...]:
    """The warning about a rectification that magnifies, because it must crop what only one eye recorded.

    Raises:
        InputError: so little remains that the calibration cannot belong to this recording.
    """
    if zoom > MAX_ZOOM:
        raise InputError(
            FIELD,
            f"rectifying with it magnifies {zoom:.1f} times and cuts most of the view away.",
            "Give the calibration of this recording; check R, T and the distortion's order k1 k2 p1 p2 k3.",
        )
    if zoom <= WARN_ZOOM:
        return ()
    text = f"rectification magnifies {zoom:.2f} times and cuts the margins away"
    return (Notice.warning(NoticeCode.MAGNIFIED, text),)
