"""Recordings that are written as files, so that wrong stereo, masks and calibration meet the checks of the input.

A recording is a phantom, so that the phantom's own writers write it. Its settings are what the user believes of the
endoscope; `drawn` is how it was really drawn.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from intrasplat.options import ReconstructionOptions
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import Phantom, PhantomFrame, write_stereomis

Spoil = Callable[[PhantomFrame, int], PhantomFrame]
STEREOMIS_CALIBRATION = "StereoCalibration.ini"


@dataclass(frozen=True)
class Recording(Phantom):
    """A phantom whose frames are those of `drawn`, each degraded by spoil(frame, index).

    masks: whether the user has them
    """

    drawn: Phantom
    spoil: Spoil
    masks: bool = True

    def frame(self, index: int) -> PhantomFrame:
        """Frame 0 <= index < T of both eyes, as recorded."""
        return self.spoil(self.drawn.frame(index), index)


def recording_of(
    drawn: Phantom, spoil: Spoil | None = None, *, baseline_mm: float | None = None, masks: bool = True
) -> Recording:
    """A degraded recording of `drawn`; its calibration states baseline_mm if that is given."""
    settings = drawn.settings
    if baseline_mm is not None:
        settings = dataclasses.replace(settings, baseline_mm=baseline_mm)
    return Recording(settings, drawn.surface, drawn.paint, drawn, spoil or _as_drawn, masks)


def write_recording(recording: Recording, folder: Path) -> ReconstructionRequest:
    """Write frames of both eyes, masks and calibration into the folder. Returns what a user would request with them."""
    write_stereomis(recording, folder, masks=recording.masks)
    options = ReconstructionOptions(mask_source="given" if recording.masks else "auto")
    return ReconstructionRequest(clip=folder, calibration=folder / STEREOMIS_CALIBRATION, options=options)


def _as_drawn(frame: PhantomFrame, index: int) -> PhantomFrame:
    del index
    return frame
