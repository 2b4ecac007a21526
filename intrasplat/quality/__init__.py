"""Judge a trained scene.

In: a trained model, its clip and the held-out frames. Out: the quality report, with scores and warnings, and how far to
trust each Gaussian.
Verbs: trust.trust, quality.first_report, judge.judged, baselines.copy_baselines.
"""
