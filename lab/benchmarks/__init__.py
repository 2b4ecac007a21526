"""Programs that measure: bm_*.py time one thing each, gpu/ checks a GPU, pages/ writes docs/results/index.md."""
