"""A clip with depth in; a trained run out, and its scene in whole numbers.

Verbs: prepare.prepare builds a run from a Setup, loop.train is the only training loop, resume.resume continues a
stopped run, rate_distortion.round_model chooses how coarse a scene may be stored.
"""
