"""The laboratory: synthetic tissue, adverse conditions, rival systems, evaluations, benchmarks. Never installed."""
