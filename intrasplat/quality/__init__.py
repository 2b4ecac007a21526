"""A trained run and its held-out frames in, the quality report out: scores, checks, what the clip saw of each Gaussian.

Verbs: trust.trust, quality.first_report, judge.judged, baselines.copy_baselines.
"""
