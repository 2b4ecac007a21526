"""`make gpu-check`: a machine with an NVIDIA GPU in, docs/results/gpu-*.csv out; check.py runs the parts."""
