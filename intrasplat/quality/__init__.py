"""Judge a trained scene.

In: a trained model, its clip, the held-out frames. Out: the quality report, and the trust in each Gaussian.
Verbs: trust.trust, report.first_report, score.score_model, baselines.copy_baselines.
"""
