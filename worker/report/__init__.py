"""A trained run and its held-out frames in, the quality report out: scores, checks, what the clip saw of each Gaussian.

Verbs: quality.measure, quality.build_report, trust.trust, baselines.copy_baselines.
"""
