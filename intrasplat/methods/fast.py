"""`fast`, our default: `paper` with the departures below, in the order in which a clip meets them.

All other settings are those of paper.py. A line "Gain" says what `fast` loses without the departure, on held-out
frames after the same number of iterations, and the processor seconds that it costs (saves, where negative);
`python -m lab.benchmarks.bm_departures` measures and writes these lines. docs/method.md has the table.

`instant`, `quality` and `small`, at the end, are `fast` with other numbers.
"""

from __future__ import annotations

from dataclasses import replace

from intrasplat.fusion import FusionSettings
from intrasplat.methods.method import Departure, departing
from intrasplat.methods.paper import PAPER
from intrasplat.names import BUDGETS_S
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.optimize import Rate

FEW_POINTS, MANY_POINTS = 20_000, 80_000
"""Points per image."""
MANY_POINTS_FROM_S = 9.0
"""From this budget on a run starts with MANY_POINTS, on two cores (docs/decisions/training.md). A faster machine could
afford them sooner, but nothing measures it, because a resumed run must start with the same points."""

DEPARTURES = (
    # Points
    #
    # A grid on the first frame; tissue that is hidden there comes from later frames (intrasplat/fusion/fill.py). The
    # paper draws a tenth of the pixels at random.
    # Gain: phantom-pull +1.01 dB, +3 s; d4d-a +6.15 dB, +11 s.
    Departure(
        "grid of points",
        {"fusion": FusionSettings(mode="fill"), "points_per_image": MANY_POINTS, "points_by_budget": True},
    ),
    # The grid leaves no gaps, so nothing has to be split, and a step costs the same from first to last.
    # Gain: phantom-pull +0.16 dB, 0 s; d4d-a +0.02 dB, -2 s.
    Departure("no densification", {"densify": None}),
    #
    # Motion
    #
    # All Gaussians share the centres and widths of their bases (intrasplat/splat/deformation/shared.py): a third of
    # the numbers, and motion is linear in them, so that tracks can initialise them.
    # Gain: phantom-pull +2.61 dB, -7 s; d4d-a +3.01 dB, -34 s.
    Departure("shared bases", {"deformation": SharedBasis.kind, "start_width": None}),
    # As many bases as the motion of the tracks needs, not 17 (intrasplat/motion/capacity.py). Above 33 Adam has no
    # first moments (Preset.with_bases).
    # Gain: phantom-pull +0.15 dB, +2 s; d4d-a +0.69 dB, 0 s.
    Departure("bases by the scene", {"bases": None}, needs=("shared bases",)),
    # Optical flow gives every Gaussian its motion before the first step, by linear least squares
    # (intrasplat/motion/tracks.py); the paper starts at rest.
    # Gain: phantom-pull +1.94 dB, +4 s; d4d-a +1.24 dB, +5 s.
    Departure("tracks", {"tracks": True}, needs=("shared bases",)),
    # The colour changes on the same bases, because the lamp moves with the camera and wet tissue glitters.
    # Gain: phantom-pull +0.51 dB, 0 s; d4d-a +0.60 dB, +4 s.
    Departure("moving colour", rates={"motion_colour": Rate(5e-2, 5e-3)}, needs=("shared bases",)),
    #
    # Start
    #
    # Opaque Gaussians of half the size show the first frame before the first step.
    # Gain: phantom-pull +1.35 dB, -2 s; d4d-a +1.50 dB, -15 s.
    Departure("opaque and small at the start", {"opacity": 0.9, "spread": 0.5}),
    # One colour for all directions: an endoscope sees tissue from too few directions to fit spherical harmonics.
    # Gain: phantom-pull +0.00 dB, 0 s; d4d-a +0.01 dB, -4 s.
    Departure("no harmonics", {"sh_degree": 0, "sh_every": 0}, rates={"sh_rest": Rate(0.0)}),
    #
    # Steps
    #
    # Every frame once before any comes again, so that successive steps see frames from all over the clip.
    # Gain: phantom-pull +0.14 dB, 0 s; d4d-a -0.06 dB, 0 s.
    Departure("epochs", {"order": "epochs"}),
    # A step renders both eyes of its frame, from one motion (docs/decisions/two-eyes.md).
    # Gain: d4d-a-stereo -0.89 dB (right eye +7.50), +36 s.
    Departure("both eyes", {"both_eyes": True}),
    # One number of each Gaussian says how much brighter the right eye sees it (docs/decisions/two-eyes.md). It needs
    # a colour without harmonics.
    # Gain: d4d-a-stereo +2.05 dB (right eye +2.29), -2 s.
    Departure(
        "gloss",
        rates={"gloss": Rate(2e-2, 5e-3), "motion_gloss": Rate(2e-2, 2e-3)},
        needs=("no harmonics", "both eyes"),
    ),
    # Motion learns up to thirty times faster: the published rates are made for 3000 steps (docs/decisions/training.md).
    # Gain: phantom-pull +1.37 dB, 0 s; d4d-a +1.35 dB, 0 s.
    Departure(
        "faster motion",
        rates={
            "motion_mean": Rate(1.5e-2, 1.5e-3),
            "motion_quaternion": Rate(5e-2, 5e-3),
            "motion_log_scale": Rate(5e-2, 5e-3),
        },
    ),
    # Colour and shape learn four to ten times faster, and all rates fall (docs/decisions/training.md).
    # Gain: phantom-pull +0.08 dB, 0 s; d4d-a +0.03 dB, -2 s.
    Departure(
        "faster colour and shape",
        rates={
            "mean": Rate(1.6e-3, 5e-5),
            "quaternion": Rate(1e-2, 3e-3),
            "log_scale": Rate(2e-2, 6e-3),
            "opacity": Rate(5e-2, 1.5e-2),
            "colour": Rate(2.5e-2, 6e-3),
        },
    ),
    # Adam forgets sooner (paper: 0.9 and 0.999), since its moments are of other frames (docs/decisions/training.md).
    # Gain: phantom-pull +0.11 dB, 0 s; d4d-a +0.35 dB, -2 s.
    Departure("short moments of Adam", rates={"beta1": 0.3, "beta2": 0.95}),
    # L1 has the same slope for any error; Huber's falls, so steps shrink at the end (docs/decisions/training.md).
    # Gain: phantom-pull +0.55 dB, 0 s; d4d-a +0.18 dB, +4 s.
    Departure("Huber loss of colour", loss={"colour_huber_delta": 0.1}),
    # Depth is divided by alpha, so that a half-transparent surface does not count as near (intrasplat/splat/loss.py).
    # Gain: phantom-pull -0.01 dB, 0 s; d4d-a +0.21 dB, -7 s.
    Departure("mean depth", loss={"normalised_depth": True}),
    #
    # Schedule and end
    #
    # Rates rise again when the iterations have doubled, and the last models of each cycle are averaged
    # (intrasplat/train/schedule.py), so that training may end after any cycle. An average needs Gaussians of one
    # number.
    # Gain: phantom-pull -0.08 dB, 0 s; d4d-a -0.07 dB, 0 s.
    Departure("warm restarts and averages", {"warm_restarts": True}, needs=("no densification",)),
    # A run with a budget ends if doubling its iterations gained less on validation frames (docs/decisions/training.md).
    # Gain: phantom-pull -0.15 dB, -21 s; d4d-a -0.03 dB, +6 s.
    Departure("early stopping", {"min_gain_db": 0.25}, needs=("warm restarts and averages",)),
    # Seconds end a run, not iterations.
    Departure("budget in seconds", {"iterations": None, "budget_s": BUDGETS_S["fast"]}),
)
"""The differences of `fast` from `paper`. No two departures set the same value."""

FAST = departing(PAPER, DEPARTURES, "fast")

INSTANT = replace(
    FAST,
    name="instant",
    points_per_image=FEW_POINTS,
    rates=FAST.rates.times(1.6),  # a run of a hundred steps gains 0.2 to 0.4 dB by it (docs/decisions/input.md)
    budget_s=BUDGETS_S["instant"],
)
"""`fast` for a few seconds."""

QUALITY = replace(FAST, name="quality", min_gain_db=0.05, budget_s=BUDGETS_S["quality"])
"""`fast` for minutes: early stopping ends it later."""

SMALL = replace(
    FAST,
    name="small",
    points_per_image=FEW_POINTS,
    points_by_budget=False,
    max_bases=17,
    rates=replace(FAST.rates, motion_log_scale=Rate(0.0)),
    budget_s=BUDGETS_S["small"],
)
"""`fast` for small files: a quarter of the Gaussians, half the bases, and scales that do not move. Of all reductions
these lose least per byte (docs/decisions/training.md)."""


def points_for(budget_s: float) -> int:
    """The points per image that score best after so many seconds of training."""
    return FEW_POINTS if budget_s < MANY_POINTS_FROM_S else MANY_POINTS
