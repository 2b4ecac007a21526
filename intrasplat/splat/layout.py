"""The rows of a Gaussian's state and the entries of a camera vector, for torch, NumPy, Numba and Triton alike.

Symbols: N Gaussians. The compiled kernels of the CPU are cached by a hash of this file.
"""

from __future__ import annotations

# A state is [ROWS, N]. A motion moves the first CHANNELS rows, the first COLOUR_CHANNELS, or all. A GPU stores the
# opacity's logit as one more row.
MEAN_ROW, QUATERNION_ROW, LOG_SCALE_ROW, COLOUR_ROW, GLOSS_ROW, OPACITY_ROW = 0, 3, 7, 10, 13, 14
MEAN = slice(MEAN_ROW, QUATERNION_ROW)
QUATERNION = slice(QUATERNION_ROW, LOG_SCALE_ROW)  # wxyz
LOG_SCALE = slice(LOG_SCALE_ROW, COLOUR_ROW)
COLOUR = slice(COLOUR_ROW, GLOSS_ROW)  # the constant harmonic
GLOSS = slice(GLOSS_ROW, OPACITY_ROW)  # how much brighter the right eye sees it than the left, in all three colours
GEOMETRY = slice(MEAN_ROW, COLOUR_ROW)  # rows that the rasteriser reads and computes gradients of
CHANNELS = COLOUR_ROW
COLOUR_CHANNELS = GLOSS_ROW  # channels of a motion that moves the colour too
ROWS = OPACITY_ROW
VALUES = OPACITY_ROW + 1

# A camera vector [CAMERA]: intrinsics and image size in pixels, side, dim, enlarged along x and y, recorded_depth [4]
# (intrasplat/splat/camera.py), camera_from_world [3, 4] row-major.
FX, FY, CX, CY, WIDTH, HEIGHT, SIDE, DIM, ENLARGED = range(9)
RECORDED = ENLARGED + 2
POSE = RECORDED + 4
CAMERA = POSE + 12
