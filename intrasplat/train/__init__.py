"""Training: a clip with depth becomes a trained run, and its model is quantised for storage.

Functions: prepare.prepare builds a run from a Setup, loop.train trains it to its end, resume.resume continues a
stopped run, rate_distortion.round_model chooses the step of quantisation.
"""
