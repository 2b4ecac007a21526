"""Where each number of a Gaussian and of a camera lies, for torch, NumPy, Numba and Triton alike.

Symbols: N Gaussians. The compiled kernels of the CPU are cached by a hash of this file.
"""

from __future__ import annotations

# A state [ROWS, N]; a motion moves the first CHANNELS rows, those and the colour, or all. A GPU keeps the opacity's
# logit as one row more.
MEAN_ROW, QUATERNION_ROW, LOG_SCALE_ROW, COLOUR_ROW, GLOSS_ROW, OPACITY_ROW = 0, 3, 7, 10, 13, 14
MEAN = slice(MEAN_ROW, QUATERNION_ROW)
QUATERNION = slice(QUATERNION_ROW, LOG_SCALE_ROW)  # wxyz
LOG_SCALE = slice(LOG_SCALE_ROW, COLOUR_ROW)
COLOUR = slice(COLOUR_ROW, GLOSS_ROW)  # the constant harmonic
GLOSS = slice(GLOSS_ROW, OPACITY_ROW)  # by how much the right eye sees it brighter than the left, in all three colours
GEOMETRY = slice(MEAN_ROW, COLOUR_ROW)  # what the rasteriser reads of a state, and gives gradients of
CHANNELS = COLOUR_ROW
COLOUR_CHANNELS = GLOSS_ROW  # of a motion that moves the colour, too
ROWS = OPACITY_ROW
VALUES = OPACITY_ROW + 1

# A camera vector [CAMERA]: intrinsics in pixels, the image's size, what it sees of the gloss, what it enlarges along x
# and y, the recording's depth [4] (intrasplat/splat/camera.py), camera_from_world [3, 4] row-major
FX, FY, CX, CY, WIDTH, HEIGHT, SIDE, DIM, ENLARGED = range(9)
RECORDED = ENLARGED + 2
POSE = RECORDED + 4
CAMERA = POSE + 12
