"""`paper`: Deform3DGS as published (Yang et al., MICCAI 2024), from the first point to the last iteration."""

from __future__ import annotations

from intrasplat.fusion import FusionSettings
from intrasplat.methods.method import DensifySettings, Preset
from intrasplat.splat.deformation import GaussianFdm
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import Rate, Rates

PAPER_ITERATIONS = 3000
FALLING = Rate(1.6e-3, 5.06e-5)
"""1.6e-3 falls log-linearly to a hundredth over 4000 steps, of which 3000 are made: 1.6e-3 * 0.01**(3000 / 4000)."""

PAPER = Preset(
    name="paper",
    # Points: all pixels of the first frame and a tenth of those that moved later; a tenth of all of these is drawn
    # ("Motion-Aware Point Fusion").
    fusion=FusionSettings(mode="paper"),
    points_per_image=None,
    points_by_budget=False,
    # Motion: 17 bases of every Gaussian and channel, at rest before the first step ("Flexible Deformation Modeling").
    deformation=GaussianFdm.kind,
    bases=17,
    max_bases=None,
    tracks=False,
    start_width=0.01,
    # Start: faint Gaussians as wide as the distance to their neighbours, of one colour; harmonics follow later.
    opacity=0.1,
    spread=1.0,
    sh_degree=3,
    sh_every=500,
    # Steps: one frame of the left eye, drawn at random.
    order="random",
    frames_a_step=1,
    both_eyes=False,
    # Schedule: rates fall once; the model of the last step is the result.
    warm_restarts=False,
    min_gain_db=None,
    rates=Rates(
        mean=FALLING,
        quaternion=Rate(1e-3),
        log_scale=Rate(5e-3),
        opacity=Rate(5e-2),
        colour=Rate(2.5e-3),
        gloss=Rate(0.0),
        sh_rest=Rate(1.25e-4),
        motion_mean=FALLING,
        motion_quaternion=FALLING,
        motion_log_scale=FALLING,
        motion_colour=Rate(0.0),
        motion_gloss=Rate(0.0),
    ),
    # Loss: L1 of colour and of inverse depth, 1 : 1, depth as blended ("Optimization").
    loss=LossSettings(normalised_depth=False),
    # Gaussians are split and pruned every 100 steps from step 600 on (Kerbl et al. 2023).
    densify=DensifySettings(),
    # End
    iterations=PAPER_ITERATIONS,
    budget_s=None,
)
