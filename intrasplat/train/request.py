"""The request that intrasplat/pipeline.py takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from intrasplat.clip import ClipLimits, DepthClip
from intrasplat.clip.given_field import Mask
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import preset_named
from intrasplat.options import ReconstructionOptions
from intrasplat.poses import StoredPoses


@dataclass(frozen=True)
class ReconstructionRequest:
    """A clip to reconstruct, and all options of its reconstruction.

    clip           a path, or a clip with depth in memory, which is neither decoded nor matched
    seconds        seconds by stage already spent on such a clip, for the report
    fov_mask       the field of view of clips on disk, a PNG or [H, W] bool (intrasplat/clip/given_field.py)
    poses          of the camera, a file or as stored (intrasplat/poses/pose_file.py)
    own_preset     used instead of the preset that options name
    accepted_at_s  Unix time at which the clip was accepted, for t_post_s; None means now
    segmenter      an ONNX file that finds the instruments of clips without masks (intrasplat/instruments/segmenter.py)
    limits         what this machine accepts; None means what its memory allows
    """

    clip: Path | DepthClip
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    right: Path | None = None
    calibration: Path | None = None
    masks: Path | None = None
    fov_mask: Path | Mask | None = None
    poses: Path | StoredPoses | None = None
    segmenter: Path | None = None
    own_preset: Preset | None = None
    device: str = "auto"
    accepted_at_s: float | None = None
    limits: ClipLimits | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def preset(self) -> Preset:
        """The preset to train with. Raises InputError if options name an unknown one."""
        return self.own_preset or preset_named(self.options.preset, self.options.budget_s)
