"""The CPU backend: Numba kernels on explicit vectors, one thread a core; obeys the contract of worker/raster.

vectors -> simd -> bins -> project -> blend -> rasterizer (buffers and calls) -> autograd (rasterize);
update, harmonics -> motion -> model (the fused training step) -> compilation.
"""

from worker.machine.cache import use_kernel_cache

use_kernel_cache()

# The cache folder must be set before a kernel is declared.
from worker.raster.cpu.autograd import rasterize  # noqa: E402
from worker.raster.cpu.compilation import compile_kernels  # noqa: E402
from worker.raster.cpu.rasterizer import Gradients, Rasterizer, padded  # noqa: E402

__all__ = ["Gradients", "Rasterizer", "compile_kernels", "padded", "rasterize"]
