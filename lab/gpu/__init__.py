"""`make gpu-check`: a machine with an NVIDIA GPU in, lab/rows/gpu-*.csv out; check.py runs the parts."""
