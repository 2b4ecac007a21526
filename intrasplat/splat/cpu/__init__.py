"""The CPU backend: Numba kernels on explicit vectors, one thread per core. splat/camera.py is its contract.

vectors -> simd -> bins -> project -> blend -> rasterizer (buffers and calls) -> autograd (rasterize);
update, harmonics -> motion -> model (the fused training step) -> compilation.
"""

from intrasplat.splat.cpu.autograd import rasterize
from intrasplat.splat.cpu.compilation import compile_kernels
from intrasplat.splat.cpu.rasterizer import Gradients, Rasterizer, padded

__all__ = ["Gradients", "Rasterizer", "compile_kernels", "padded", "rasterize"]
