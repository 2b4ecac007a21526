"""What is fixed before a run: the clip with depth, its split, the options, the caller's hooks, the clocks."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from intrasplat.clip import DepthClip, Eye, FrameSplit
from intrasplat.machine.timing import Stopwatch, Timings
from intrasplat.methods.method import Preset
from intrasplat.options import ReconstructionOptions
from intrasplat.splat.backend import CPU, Device
from intrasplat.train.hooks import TrainingHooks


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before training, and the clocks.

    clip           frames with depth, of the right eye too if there is one
    split          the frames to train on, and the held-out ones
    preset         as requested; prepare() fills in what it leaves to the scene
    options        as requested, among them seed, length and eyes
    device         holds the model and renders it
    hooks          the caller's callbacks
    timings        seconds of each stage so far
    clock          t_train_s, which starts with the setup
    accepted_at_s  Unix time from which t_post_s counts
    gpu_is_idle    whether there is a GPU that the preset's motion cannot use
    """

    clip: DepthClip
    split: FrameSplit
    preset: Preset
    options: ReconstructionOptions
    device: Device = CPU
    hooks: TrainingHooks = field(default_factory=TrainingHooks)
    timings: Timings = field(default_factory=Timings)
    clock: Stopwatch = field(default_factory=Stopwatch)
    accepted_at_s: float = field(default_factory=time.time)
    gpu_is_idle: bool = False

    @property
    def teaching_eyes(self) -> tuple[Eye, ...]:
        """The eyes to train on, left first."""
        both = self.options.eyes == "both" and self.preset.both_eyes
        return self.clip.eyes if both else self.clip.eyes[:1]

    @property
    def sides(self) -> tuple[float, float]:
        """Camera.side of the left and the right eye, for the gloss; 0 where gloss is not modelled.

        Gloss needs two eyes to be measured; with spherical harmonics it is not modelled.
        """
        return (-0.5, 0.5) if len(self.teaching_eyes) > 1 and self.preset.sh_degree == 0 else (0.0, 0.0)

    @property
    def fixed_iterations(self) -> int | None:
        """The requested iterations, else the preset's own; None where seconds limit the run."""
        return length_of(self.options, self.preset)[0]

    @property
    def budget_s(self) -> float:
        """The seconds of training, requested or the preset's; only where fixed_iterations is None."""
        _, budget_s = length_of(self.options, self.preset)
        assert budget_s is not None
        return budget_s


def length_of(options: ReconstructionOptions, preset: Preset) -> tuple[int | None, float | None]:
    """The iterations of a run, or else the seconds of its training; one of the two is None."""
    fixed = options.iterations or (None if options.budget_s else preset.iterations)
    return fixed, None if fixed is not None else options.budget_s or preset.budget_s
