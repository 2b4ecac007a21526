"""Work on one frame of both eyes: match it, transfer depth to the right eye, drop depth beside instruments.

Symbols: T frames, H W pixels of one eye; d disparity, x_left - x_right in px. depth_mm = fx baseline_mm / (d - offset).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.field_of_view import Fields, filled
from intrasplat.clip.splashes import Splashes
from intrasplat.clip.types import DepthClip, Eye
from intrasplat.instruments import Finder
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.stereo.matching import MIN_CONFIDENCE, Grey, MatchPlan, match
from intrasplat.stereo.nearness import nearness
from intrasplat.stereo.registration import Registration
from intrasplat.stereo.right_eye import moved_depth, moved_tissue, painted_over, seen_nowhere

if TYPE_CHECKING:  # matching itself needs no calibration module
    from intrasplat.clip.calibration import RectifiedClip

SURE = 128
"""Minimum confidence, of 255, of a reliable depth."""
GAP_SHARE = 0.03
"""Share of the width: gaps in stereo depth that are closed to find what both eyes see."""
BESIDE_PX = 6
"""Tissue this near to an instrument gets no depth: matching windows overlap the edge and match the instrument."""


def grey_of(rgb: NDArray[np.uint8]) -> Grey:
    """Grey [H, W] of a picture [H, W, 3]."""
    grey: Grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return grey


@dataclass(frozen=True, eq=False)
class FrameWork:
    """Data common to all frames of a clip, and the clip that they fill. Frames are independent, in any order.

    matched  the clip with both eyes; it has all pictures, and each frame's depth after finish(i)
    label    [H, W] labels that are painted into both eyes' pictures
    fields   the eyes' fields of view
    splashes drops on the eyes' lenses
    finder   finds the instruments of a clip without masks; None: the clip has masks
    counts   [T, 3] number of tissue pixels, of those with depth, of those with sure depth
    sure     [T, 3] `seen`, `clear` and `missed` of each FoundMask
    """

    clip: RectifiedClip
    plan: MatchPlan
    registration: Registration
    matched: DepthClip
    right: Eye
    label: NDArray[np.bool_]
    fields: Fields
    splashes: Splashes
    finder: Finder | None = None
    counts: NDArray[np.int64] = field(init=False)
    sure: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", np.zeros((self.clip.frame_count, 3), np.int64))
        object.__setattr__(self, "sure", np.zeros((self.clip.frame_count, 3)))

    @classmethod
    def begin(
        cls,
        clip: RectifiedClip,
        rgb: NDArray[np.uint8],
        right_rgb: NDArray[np.uint8],
        measured: Sequence[int],
        registration: Registration,
        plan: MatchPlan,
        fields: Fields,
        splashes: Splashes,
        finder: Finder | None = None,
    ) -> FrameWork:
        """The work before its first frame. The right eye has the calibrated baseline and the measured rotation.

        Labels are searched in the measured frames alone.
        """
        count, shape = clip.frame_count, rgb.shape[:3]
        middle, sometime_tissue = measured[len(measured) // 2], np.zeros(shape[1:], np.bool_)
        for i in measured:
            sometime_tissue |= clip.tissue[i]
            let_go(clip.tissue[i])
        label = painted_over(rgb[middle], right_rgb[middle], ~sometime_tissue)  # as recorded
        right = Eye(
            rgb=right_rgb,
            tissue=_own(clip.tissue_right, shape),
            depth_mm=mapped_zeros(shape, np.float32),
            depth_confidence=mapped_zeros(shape, np.uint8),
            intrinsics=registration.camera,
            world_from_camera=np.tile(registration.left_from_right, (count, 1, 1)),
            field_of_view=fields.right,
        )
        matched = DepthClip(
            rgb=rgb,
            tissue=_own(clip.tissue, shape),
            depth_mm=mapped_zeros(shape, np.float32),
            depth_confidence=mapped_zeros(shape, np.uint8),
            intrinsics=clip.intrinsics,
            world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
            frame_times_s=clip.frame_times_s,
            right=right,
            registration=registration.report_entry,
            field_of_view=fields.left,
            fov=fields.entry,
        )
        return cls(clip, plan, registration, matched, right, label, fields, splashes, finder)

    @cached_property
    def _rectified_field(self) -> NDArray[np.uint8] | None:
        field = self.fields.right
        return None if field is None else self.registration.rectified(field.astype(np.uint8))

    def _supported(self, i: int) -> NDArray[np.uint8] | None:
        """[H, W] 1 where the right eye sees in a frame, in the calibrated eye's pixels; None: in the whole picture."""
        covered, field = self.splashes.covered(i, right=True), self.fields.right
        if covered is None:
            return self._rectified_field
        return self.registration.rectified((~covered if field is None else field & ~covered).astype(np.uint8))

    def greys(self, i: int) -> tuple[Grey, Grey]:
        """The pair to match. Sets the final colours of the right picture."""
        self.right.rgb[i] = self.registration.recoloured(self.right.rgb[i])
        return grey_of(self.matched.rgb[i]), self.registration.rectified(grey_of(self.right.rgb[i]))

    def tell_tissue(self, i: int, right: Grey) -> NDArray[np.bool_]:
        """The tissue [H, W] of a frame's left eye, which is also stored in the matched clip. right: of greys(i)."""
        tissue: NDArray[np.bool_] = self.matched.tissue[i]
        if self.matched.tissue is not self.clip.tissue:
            tissue[:] = self.fields.tissue(self.clip.tissue[i])
        elif self.fields.left is not None:
            tissue &= self.fields.left
        if self.finder is not None:
            rgb, offset_px = self.matched.rgb[i], self.clip.disparity_offset_px
            found = self.finder(rgb, lambda coarse: nearness(coarse, right, self.plan, offset_px))
            tissue &= ~found.tool
            self._without_drops(tissue, i)  # an instrument under a drop is not found
            self.sure[i] = found.seen, found.clear, found.missed
        return tissue

    def _without_drops(self, tissue: NDArray[np.bool_], i: int, *, right: bool = False) -> None:
        """Remove what drops cover in a frame from an eye's tissue [H, W], in place."""
        covered = self.splashes.covered(i, right=right)
        if covered is not None:
            tissue &= ~covered

    def match(self, i: int) -> None:
        """Match a frame and finish it."""
        left, right = self.greys(i)
        disparity, trust = match(left, right, self.plan, self.tell_tissue(i, right))
        beyond_infinity_px = disparity - np.float32(self.clip.disparity_offset_px)
        focal_baseline = self.clip.intrinsics.fx * self.clip.baseline_mm
        self.matched.depth_mm[i], self.matched.depth_confidence[i] = to_depth(
            beyond_infinity_px, trust, focal_baseline, self.plan.depth_range_mm
        )
        self.finish(i)

    def finish(self, i: int) -> None:
        """Transfer a frame's depth to the right eye, drop it beside instruments, and count pixels."""
        left, right, registration = self.matched, self.right, self.registration
        focal_baseline, offset_px = self.clip.intrinsics.fx * self.clip.baseline_mm, self.clip.disparity_offset_px
        if (covered := self.splashes.covered(i)) is not None:
            left.depth_mm[i][covered], left.depth_confidence[i][covered] = 0, 0
        if (supported := self._supported(i)) is not None:
            unseen = seen_nowhere(left.depth_mm[i], focal_baseline, offset_px, supported)
            left.depth_mm[i][unseen], left.depth_confidence[i][unseen] = 0, 0
        moved_mm, moved_trust = moved_depth(left.depth_mm[i], left.depth_confidence[i], focal_baseline, offset_px)
        right.depth_mm[i] = registration.recorded_depth(moved_mm)
        right.depth_confidence[i] = registration.recorded(moved_trust)
        if self.clip.tissue_right is None:
            no_tool = self.label if self.fields.left is None else self.label | ~self.fields.left
            shown = moved_tissue(left.tissue[i] | no_tool, left.depth_mm[i], focal_baseline, offset_px)
            right.tissue[i] = (registration.recorded((~shown).astype(np.uint8)) == 0) & ~self.label
        elif right.tissue is not self.clip.tissue_right:
            right.tissue[i] = self.clip.tissue_right[i]
        for eye in (left, right):
            if eye.field_of_view is not None:
                eye.depth_mm[i][~eye.field_of_view], eye.depth_confidence[i][~eye.field_of_view] = 0, 0
        if self.fields.right is not None:
            right.tissue[i] &= self.fields.right
        if self.fields.left is not None:  # what the right eye alone sees lies outside the left one's field
            right.tissue[i] &= filled(right.depth_mm[i] > 0, GAP_SHARE * self.clip.intrinsics.width)
        self._without_drops(left.tissue[i], i)
        self._without_drops(right.tissue[i], i, right=True)
        for eye in (left, right):
            drop_beside_instruments(eye.tissue[i], eye.depth_mm[i], eye.depth_confidence[i])
        trust = left.depth_confidence[i][left.tissue[i]]
        self.counts[i] = trust.size, np.count_nonzero(trust), np.count_nonzero(trust >= SURE)
        for eye in (left, right):
            eye.let_go(i)


def _own(masks: NDArray[np.bool_] | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Masks [T, H, W] that may be written: these, or new ones to be filled frame by frame."""
    return masks if masks is not None and masks.flags.writeable else mapped_zeros(shape, np.bool_)


def to_depth(
    beyond_infinity_px: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    focal_baseline: float,
    depth_range_mm: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth focal_baseline / beyond_infinity_px in mm, and confidence [H, W]; both are 0 at invalid pixels."""
    nearest_mm, farthest_mm = depth_range_mm
    valid = confidence >= MIN_CONFIDENCE
    valid &= (beyond_infinity_px >= focal_baseline / farthest_mm) & (beyond_infinity_px <= focal_baseline / nearest_mm)
    depth_mm = np.where(valid, focal_baseline / np.where(valid, beyond_infinity_px, 1.0), 0.0)
    return depth_mm.astype(np.float32), np.where(valid, confidence, 0).astype(np.uint8)


def drop_beside_instruments(
    tissue: NDArray[np.bool_], depth_mm: NDArray[np.float32], confidence: NDArray[np.uint8]
) -> None:
    """Set depth and confidence [H, W] to 0, in place, on tissue within BESIDE_PX of other pixels."""
    side = 2 * BESIDE_PX + 1
    if not tissue.all():
        beside = tissue & (cv2.dilate((~tissue).astype(np.uint8), np.ones((side, side), np.uint8)) > 0)
        depth_mm[beside], confidence[beside] = 0, 0
