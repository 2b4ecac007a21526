"""Benchmarks: each bm_*.py measures one thing and prints a table; most also write a CSV file for lab/rows/."""
