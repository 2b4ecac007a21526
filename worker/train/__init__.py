"""A clip with depth in, a trained run out.

Verbs: prepare.prepare builds a run, loop.train is the only training loop, resume.resume continues a stopped run.
"""
