"""Points come in; Gaussians go out, with their motion, the loss that trains them and the scores that judge them.

Verbs: gaussians.initial_gaussians, deformation.motion_named and restore (fdm.py holds the FDM equation),
optimize.adam_step, metrics. loss.py is the reference of the loss that the kernels compute. constants.py and layout.py
hold the numbers that kernels compile in.
"""
