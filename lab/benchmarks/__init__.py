"""Programs that measure: bm_*.py time one thing each, gpu/ checks a GPU, pages/ writes lab/rows/index.md."""
