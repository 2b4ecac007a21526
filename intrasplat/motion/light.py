"""The light of a recording: what camera and smoke did to the tissue's colours in every frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.motion.exposure import Exposure, in_steady_light
from intrasplat.motion.veil import Veil, notice_of, warnings_of, without_veils
from intrasplat.motion.vignetting import Vignetting, evenly_lit, notice_of_border
from intrasplat.notices import Notice
from intrasplat.report import LightChanges

Floats = NDArray[np.float32]
REPORTED_DIGITS = 3
"""Decimals of the report's figures: finer than they are measured."""


@dataclass(frozen=True, eq=False)
class RecordedLight:
    """The light in which a clip was recorded, against the light that its model has.

    exposure    gains of every frame; None: they hardly change
    vignetting  of the pictures; None: it is weak
    veils       smoke before the left eye and, if there is one, the right eye; empty: none was found
    """

    exposure: Exposure | None = None
    vignetting: Vignetting | None = None
    veils: tuple[Veil, ...] = ()

    def changes(self, clip: DepthClip) -> LightChanges | None:
        """Its figures for the report, of the left eye; None: there are none."""
        entry = dict[str, Any]()
        if self.exposure is not None:
            red, _, blue = np.exp(self.exposure.log_tints).T
            entry |= {"reference": self.exposure.reference, "stops": _rounded(self.exposure.stops)}
            entry |= {"red": _rounded(red), "blue": _rounded(blue)}
        if self.veils:
            entry["smoke_share"] = _rounded(self.veils[0].share_taken())
        if self.vignetting is not None:
            share = self.vignetting.border_share(clip.intrinsics, np.asarray(clip.tissue.any(axis=0)))
            entry["vignetting"] = round(share, REPORTED_DIGITS)
        return LightChanges(**entry) if entry else None

    def notices(self, clip: DepthClip, changes: LightChanges | None) -> Iterator[Notice]:
        """What the report says about it. changes: as changes() found it."""
        if self.veils:
            yield notice_of(self.veils[0])
        if changes is not None and changes.vignetting is not None:
            yield notice_of_border(changes.vignetting)
        if self.exposure is not None:
            yield self.exposure.notice(clip.frame_times_s)

    def warnings(self, clip: DepthClip, train: Sequence[int]) -> tuple[Notice, ...]:
        """What makes the result less right. train: the frames of the clip in which it was measured."""
        thick = warnings_of(self.veils[0]) if self.veils else ()
        return thick if self.exposure is None else (*thick, *self.exposure.warnings(train, clip.frame_times_s))

    def removed(self, clip: DepthClip) -> DepthClip:
        """The clip to train on: without smoke, in even and steady light. The clip itself where none was found."""
        if self.veils:
            clip = without_veils(clip, self.veils)
        if self.vignetting is not None:
            clip = evenly_lit(clip, self.vignetting)
        return clip if self.exposure is None else in_steady_light(clip, self.exposure)

    def added(self, rgb: Floats, index: int, depth_mm: Floats, lens: Intrinsics, *, right: bool = False) -> Floats:
        """Colours [H, W, 3] of the model in a frame as that eye recorded it; depth_mm [H, W] is the render's."""
        if self.exposure is not None:
            rgb = rgb * np.exp(self.exposure.log_gains[index]).astype(np.float32)
        if self.vignetting is not None:
            rgb = rgb * self.vignetting.picture(lens)[..., None]
        if self.veils:
            veil = self.veils[int(right)]
            rgb = veil.drawn_over(rgb, veil.transmission(index, depth_mm))
        return rgb

    def settings(self) -> dict[str, Any]:
        """What a scene stores to show a moment as the left eye recorded it; JSON."""
        gains = None if self.exposure is None else self.exposure.log_gains
        return light_settings(gains, self.vignetting, self.veils[0] if self.veils else None)

    def stored(self) -> dict[str, Any]:
        """All of it as JSON, for read()."""
        exposure = self.exposure
        gains = None if exposure is None else [exposure.log_gains.tolist(), exposure.reference]
        even = None if self.vignetting is None else self.vignetting.stored()
        return {"exposure": gains, "vignetting": even, "veils": [veil.stored() for veil in self.veils]}

    @classmethod
    def read(cls, stored: Mapping[str, Any], frames: int) -> RecordedLight:
        """The light of a clip of `frames` frames that stored() wrote.

        Raises:
            KeyError, TypeError, ValueError: it is not one.
        """
        gains = stored["exposure"]
        exposure = None if gains is None else Exposure(np.array(gains[0], np.float64), int(gains[1]))
        vignetting = None if stored["vignetting"] is None else Vignetting(*map(float, stored["vignetting"]))
        return cls(exposure, vignetting, tuple(Veil.read(veil, frames) for veil in stored["veils"]))


def light_settings(
    log_gains: NDArray[np.float64] | None, vignetting: Vignetting | None, veil: Veil | None
) -> dict[str, Any]:
    """The settings of a scene that was recorded in this light; JSON. log_gains [T, 3]. None: there is none."""
    gains = {} if log_gains is None else {"log_gains": log_gains.tolist()}
    even = {} if vignetting is None else {"vignetting": vignetting.stored()}
    return gains | even | ({} if veil is None else {"veil": veil.stored()})


def _rounded(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple((np.round(values, REPORTED_DIGITS) + 0.0).tolist())
