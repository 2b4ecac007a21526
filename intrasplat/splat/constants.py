"""The bounds and factors of the equations, which the reference, the loss and the kernels of every device share.

Plain numbers: Numba and Triton compile them in. The compiled kernels of the CPU are cached by a hash of this file.
"""

from __future__ import annotations

import math

# Projection and blend (intrasplat/splat/camera.py)
NEAR = 0.2
"""Units of depth; nearer Gaussians are culled, because their projection is unbounded."""
EPS2D = 0.3
"""Pixels^2 of the recording added to both variances on the image: no Gaussian is thinner than about a pixel."""
IMAGE_MARGIN = 0.15
"""Share of the image's size by which a centre may lie outside before J is evaluated at the margin instead. Far outside,
the linearised projection would smear the Gaussian over the whole image."""
MIN_ALPHA = 1 / 255
"""Fainter contributions are dropped: less than one 8-bit step."""
MAX_ALPHA = 0.99
"""Keeps T positive, so that what lies behind still gets gradients."""
MIN_TRANSMITTANCE = 1e-4
"""A pixel with less transmittance is full: nothing more is blended into it."""
MAX_LOG2_EXP = 20.0
"""log2 of the largest value of the kernels' e^x. A Gaussian that wide, 17,000 times the median depth, covers any image
evenly, and its extent still fits into float32. An opacity of 2**-MAX_LOG2_EXP is never drawn."""
MAX_DETERMINANT = 1e300
"""A Gaussian whose covariance on the image has a larger determinant is not drawn."""

# Loss (intrasplat/splat/loss.py)
MIN_COVERAGE = 1e-2
"""A pixel with a smaller alpha has no depth loss; the bound keeps the divisions by depth finite."""

# Deformation (intrasplat/splat/deformation/fdm.py)
MIN_WIDTH = 1e-3
"""Least width of a basis, as a share of the clip. A narrower one falls between frames and its exponent overflows."""
QUARTIC_FLOOR = 1e-4
"""Added to the squared width in the quartic form, which needs no other lower bound."""

# Normalisation of the real spherical harmonics; their signs, Condon-Shortley phase included, are in the equations.
SH_C0 = math.sqrt(1 / math.pi) / 2
SH_C1 = math.sqrt(3 / math.pi) / 2
SH_C2 = (math.sqrt(15 / math.pi) / 2, math.sqrt(5 / math.pi) / 4, math.sqrt(15 / math.pi) / 4)
SH_C3 = (
    math.sqrt(35 / (2 * math.pi)) / 4,
    math.sqrt(105 / math.pi) / 2,
    math.sqrt(21 / (2 * math.pi)) / 4,
    math.sqrt(7 / math.pi) / 4,
    math.sqrt(105 / math.pi) / 4,
)

LOG2E = 1.4426950408889634
LN2 = 0.6931471805599453
