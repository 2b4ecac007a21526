"""Where compiled kernels are kept between runs.

Numba keys a kernel's cache by its own source file and does not see a change in a module it was compiled from (a
constant, an inlined helper, the vector type), so a stale kernel could run with a new layout of its arrays. All kernels
therefore live in a folder named after a hash of every source file of this package: any change starts afresh.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numba


def kernel_cache_directory() -> Path:
    """The folder of compiled kernels: $INTRASPLAT_CACHE, else $XDG_CACHE_HOME/intrasplat, else ~/.cache/intrasplat."""
    digest = hashlib.sha256(numba.__version__.encode())
    folder = Path(__file__).parent
    for source in [*sorted(folder.glob("*.py")), folder.parent / "__init__.py"]:
        digest.update(source.read_bytes())
    base = os.environ.get("INTRASPLAT_CACHE")
    if base is None:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        base = os.path.join(home, "intrasplat")
    return Path(base) / "kernels" / digest.hexdigest()[:16]


def use_kernel_cache() -> None:
    """Point Numba at that folder; must run before the first kernel is declared."""
    numba.config.CACHE_DIR = str(kernel_cache_directory())
