"""The decorator of every Numba kernel, and the folder where compiled kernels are stored between runs.

Numba keys a kernel's cache by its own source file and ignores changes in imported modules (a constant, an inlined
helper, the vector type), so a stale kernel could run with a new layout of its arrays. All kernels are therefore stored
in a folder named after a hash of the rasteriser's source files, the only files that build on each other, and of the
numbers compiled into them. After any change there, kernels are compiled anew.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    inline: str = "never",
    error_model: str = "python",
    fuses: bool = False,
) -> Any:
    """Declare a function as a kernel: compiled by Numba at its first call, cached on disk, and run without the GIL.

    The declaration touches no file. Numba's own `cache=True` would choose the folder during import.

    Args:
        inline: "always" copies the kernel into those that call it.
        error_model: "numpy": a division by zero gives inf or NaN instead of an exception.
        fuses: whether a product and a sum may become one instruction, which rounds once.
    """
    if function is None:
        return lambda declared: kernel(declared, inline=inline, error_model=error_model, fuses=fuses)
    fastmath = {"contract"} if fuses else False
    dispatcher = numba.njit(nogil=True, inline=inline, error_model=error_model, fastmath=fastmath)(function)
    dispatcher._cache = _LateCache(function)
    return dispatcher


class _LateCache:
    """Numba's cache of one kernel, opened when that kernel is first compiled or loaded."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @cached_property
    def _opened(self) -> FunctionCache:
        use_kernel_cache()
        return FunctionCache(self._function)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._opened, name)


def kernel_cache_directory() -> Path:
    """The folder of compiled kernels: $INTRASPLAT_CACHE, else $XDG_CACHE_HOME/intrasplat, else ~/.cache/intrasplat.

    Raises:
        RuntimeError: none of them is set and this user has no home directory.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    splat = Path(__file__).resolve().parents[1] / "splat"
    compiled_in = [splat / "constants.py", splat / "layout.py", *sorted(splat.glob("cpu/*.py"))]
    for source in [Path(__file__), *compiled_in]:
        digest.update(source.read_bytes())
    chosen = os.environ.get("INTRASPLAT_CACHE")
    base = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "intrasplat"
    return base / "kernels" / digest.hexdigest()[:16]


@cache
def use_kernel_cache() -> None:
    """Set Numba's cache to that folder, once per process.

    If the folder is not writable, a temporary one replaces it until the process ends, with a warning.
    """
    try:
        folder = kernel_cache_directory()
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError) as error:
        temporary = tempfile.mkdtemp(prefix="intrasplat-kernels-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        problem = f"compiled kernels cannot be kept, so every start compiles them anew: {error}"
        warnings.warn(f"{problem}; set INTRASPLAT_CACHE to a folder that can be written.", RuntimeWarning, stacklevel=2)
        folder = Path(temporary)
    numba.config.CACHE_DIR = str(folder)
