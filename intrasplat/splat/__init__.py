"""Gaussians and their motion, the rasteriser that renders them, the loss and Adam that train them, and the scores.

Functions: rasterize.rasterize, gaussians.initial_gaussians, deformation.motion_named and restore (fdm.py has the FDM
equation), optimize.adam_step, metrics. camera.py and loss.py define what the kernels compute. constants.py and
layout.py contain the numbers that the kernels compile in.
"""
