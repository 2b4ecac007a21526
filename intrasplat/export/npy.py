"""Write large arrays as NPY files, part by part."""

from __future__ import annotations

import io

import numpy as np


def npy_head(shape: tuple[int, ...]) -> bytes:
    """The header of a float32 array in C order; its numbers follow."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return buffer.getvalue()
