"""The CPU backend: Numba kernels on explicit vectors, one thread a core. Obeys the contract of worker/raster/__init__.py.

simd -> project -> bins -> blend -> rasterizer (buffers and calls) -> rasterize (autograd) ; update (deformation, Adam).
"""

from worker.raster.cpu.cache import use_kernel_cache

use_kernel_cache()

from worker.raster.cpu.autograd import rasterize  # noqa: E402  the cache folder must be set before a kernel is declared
from worker.raster.cpu.rasterizer import Gradients, Rasterizer, Target, camera_vector, padded  # noqa: E402

__all__ = ["Gradients", "Rasterizer", "Target", "camera_vector", "padded", "rasterize"]
