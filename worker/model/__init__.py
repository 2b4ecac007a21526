"""The canonical Gaussians, their deformation in time, what is minimised and how it is scored.

Verbs: gaussians.initial_gaussians, deformation (fdm.py holds the FDM equation), loss, optimize, metrics.
"""
