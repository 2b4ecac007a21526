"""The CPU backend: Numba kernels on explicit vectors, one thread a core; obeys the contract of worker/raster.

vectors -> simd -> bins -> project -> blend -> rasterizer (buffers and calls) -> autograd (rasterize);
update, harmonics -> motion -> model (the fused training step) -> compilation.
"""

from worker.raster.cpu.autograd import rasterize
from worker.raster.cpu.compilation import compile_kernels
from worker.raster.cpu.rasterizer import Gradients, Rasterizer, padded

__all__ = ["Gradients", "Rasterizer", "compile_kernels", "padded", "rasterize"]
