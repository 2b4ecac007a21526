"""The machine's resources (GPU, cores, OpenCV, the cache of compiled kernels), clocks, and the hooks of a stage.

Verbs: gpu.find_gpu, Hooks.report_stage, Timings.measure.
"""
