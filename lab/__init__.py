"""The laboratory: synthetic tissue, conditions, rivals, evaluations and benchmarks. It is never installed."""
