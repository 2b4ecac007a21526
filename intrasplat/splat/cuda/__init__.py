"""The CUDA backend: Triton kernels, which also run, slowly, in Triton's interpreter on CPU tensors.

bins, geometry -> project -> project_backward -> blend -> rasterizer (buffers and launches) -> autograd (rasterize).

Importing it needs Triton, which comes with torch's CUDA wheels. Other packages import it only if a GPU is requested.
The interpreter is chosen when Triton is first imported, by TRITON_INTERPRET=1 in the environment.
"""

from intrasplat.splat.cuda.autograd import rasterize
from intrasplat.splat.cuda.rasterizer import CudaRasterizer, Gradients

__all__ = ["CudaRasterizer", "Gradients", "rasterize"]
