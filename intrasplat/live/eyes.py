"""The pairs of a feed as clips of one moment with depth: resized, rectified, matched, without instruments.

What a clip measures over all its frames is measured on one pair: how the eyes are registered, the field of view, the
look of tissue. The range of disparities follows the scene (follow_range).

Symbols: H W pixels of one eye of the model.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intrasplat.clip import DepthClip, StereoClip
from intrasplat.clip.calibration import load_calibration, rectify
from intrasplat.clip.features import find_features
from intrasplat.clip.sampling import thumbnail
from intrasplat.clip.shown import find_shown
from intrasplat.clip.splashes import Splashes
from intrasplat.clip.types import Eye, RgbFrame
from intrasplat.errors import InputError
from intrasplat.instruments import Finder
from intrasplat.intake.calibration.fit import fitted
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.names import Fov
from intrasplat.options import MAX_DEPTH_MM, MIN_DEPTH_MM
from intrasplat.stereo.alignment import agreed_disparities, choose_range, match_features
from intrasplat.stereo.depth import plan_matching
from intrasplat.stereo.frames import FrameWork, grey_of

DepthRange = tuple[float, float]


@dataclass(frozen=True)
class EyesSettings:
    """How pairs are read.

    width             of the model's pictures, px; None: that of the first pair
    depth_range_mm    nearest and farthest depth that is searched
    fov               as in ReconstructionOptions
    finds_instruments whether instruments are searched in every pair; else all is tissue
    """

    width: int | None = None
    depth_range_mm: DepthRange = (MIN_DEPTH_MM, MAX_DEPTH_MM)
    fov: Fov = "auto"
    finds_instruments: bool = True


class LiveEyes:
    """Reads the pairs of one feed, one at a time. Not thread-safe.

    recorded_size  (width, height) of one eye of the feed
    """

    def __init__(
        self,
        calibration: StereoCalibration | Path,
        settings: EyesSettings,
        recorded_size: tuple[int, int],
        pixel_aspect: float = 1.0,
    ) -> None:
        """calibration: of these eyes, in any size; a path: its file. recorded_size: width and height of one eye.
        pixel_aspect: width / height of a pixel.

        Raises:
            InputError: the calibration cannot be read, or is of no such eyes.
        """
        self.recorded_size, self._settings = recorded_size, settings
        width, height = recorded_size
        new_width = settings.width or width
        self._size = new_width, max(1, round(height * new_width / width))
        nothing = np.zeros((*self._size[::-1], 3), np.uint8)
        self._pair = nothing, nothing
        if isinstance(calibration, Path):
            found = load_calibration(calibration, eye_width=width, eye_height=height, pixel_aspect=pixel_aspect)
        else:
            found = fitted(calibration, width, height, pixel_aspect)
        self._rectified = rectify(self._stereo_clip(), found.resized(*self._size))
        self._work: FrameWork | None = None

    def moment(self, left: RgbFrame, right: RgbFrame, time_s: float) -> DepthClip | None:
        """The clip of one frame of a pair as recorded, [H, W, 3] each; its camera stands at the origin.

        The first pair that shows a scene tells how the eyes stand to each other; None before.

        Raises:
            InputError: the pair has another size than the first one.
        """
        height, width = left.shape[:2]
        if (width, height) != self.recorded_size or left.shape != right.shape:
            before = "x".join(map(str, self.recorded_size))
            raise InputError("feed", f"a picture has {width}x{height} pixels, the first had {before}.", "Start anew.")
        self._pair = self._resized(left, right)
        if self._work is None:
            with suppress(InputError):  # it shows nothing, or no scene that the eyes have in common
                self._work = self._measured()
        work = self._work
        if work is None:
            return None
        work.matched.rgb[0], work.right.rgb[0] = self._rectified_pair()
        work.match(0)
        other = replace(work.right, **_copies(work.right))
        return replace(work.matched, frame_times_s=np.array([time_s]), right=other, **_copies(work.matched))

    def follow_range(self, moment: DepthClip) -> None:
        """Search the disparities that a moment shows from now on."""
        clip, work = self._rectified, self._work
        assert moment.right is not None
        assert work is not None
        pair = grey_of(moment.rgb[0]), work.registration.rectified(grey_of(moment.right.rgb[0]))
        focal_baseline = clip.intrinsics.fx * clip.baseline_mm
        try:
            found = choose_range(
                [pair], clip.disparity_offset_px, focal_baseline, self._settings.depth_range_mm, agreed_disparities
            )
        except InputError:  # hardly a matching point: the range stays
            return
        plan = replace(work.plan, min_disparity_px=found[0], max_disparity_px=found[1])
        self._work = replace(work, plan=plan)

    def _resized(self, left: RgbFrame, right: RgbFrame) -> tuple[RgbFrame, RgbFrame]:
        if self._size == self.recorded_size:
            return left, right
        fewer = cv2.INTER_AREA if self._size[0] < left.shape[1] else cv2.INTER_LINEAR
        small = (np.asarray(cv2.resize(eye, self._size, interpolation=fewer), np.uint8) for eye in (left, right))
        return next(small), next(small)

    def _stereo_clip(self) -> StereoClip:
        def pairs() -> Iterator[tuple[RgbFrame, RgbFrame]]:
            yield self._pair

        width, height = self._size
        return StereoClip(
            frame_count=1, height=height, width=width, pairs=pairs, tissue=None, frame_times_s=np.zeros(1)
        )

    def _rectified_pair(self) -> tuple[RgbFrame, RgbFrame]:
        return next(iter(self._rectified.pairs()))

    def _measured(self) -> FrameWork:
        """The work on frames, with what the pair at hand shows of the eyes. Raises InputError if that is nothing."""
        settings, clip = self._settings, self._rectified
        rgb, right = (np.array(eye[None]) for eye in self._rectified_pair())
        focal_baseline = clip.intrinsics.fx * clip.baseline_mm
        nearest_px, farthest_px = (focal_baseline / each + clip.disparity_offset_px for each in settings.depth_range_mm)
        with ThreadPoolExecutor(2) as pool:
            fields, _ = find_shown(
                [rgb, right], [[thumbnail(rgb[0])], [thumbnail(right[0])]], [0], settings.fov, (), pool.map,
                may_coincide=farthest_px <= 0 <= nearest_px,
            )  # fmt: skip
            matches = match_features(*pool.map(lambda eye: find_features(grey_of(eye[0])), (rgb, right)))
            finder = Finder.of(iter(rgb), fields.left) if settings.finds_instruments else None
            registration, plan, _ = plan_matching(
                clip, rgb, right, [0], matches, pool, "cpu", settings.depth_range_mm, finder, fields
            )
        return FrameWork.begin(clip, rgb, right, [0], registration, plan, fields, Splashes(), finder)


def _copies(eye: Eye) -> dict[str, Any]:
    """The arrays of an eye by name."""
    return {name: np.array(values) for name, values in eye.arrays_at(slice(0, 1)).items()}
