"""What to reconstruct, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from contract.wire.options import ReconstructionOptions
from worker.input.clip import ClipLimits, DepthClip
from worker.methods.method import Preset
from worker.methods.registry import preset_named


@dataclass(frozen=True)
class ReconstructionRequest:
    """What to reconstruct, and how.

    clip           a path, or a clip with depth in memory, which is neither decoded nor matched
    seconds        by stage, what was spent on such a clip, for the report
    own_preset     trains in place of the preset that options name
    accepted_at_s  Unix time at which the clip was accepted, for t_post_s; None means now
    segmenter      an ONNX file that finds the instruments of clips without masks (worker/instruments/segmenter.py)
    limits         what this machine accepts; None means what its memory allows
    """

    clip: Path | DepthClip
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    right: Path | None = None
    calibration: Path | None = None
    masks: Path | None = None
    segmenter: Path | None = None
    own_preset: Preset | None = None
    device: str = "auto"
    accepted_at_s: float | None = None
    limits: ClipLimits | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def preset(self) -> Preset:
        """The preset that trains. Raises InputError if options name none that there is."""
        return self.own_preset or preset_named(self.options.preset, self.options.budget_s)
