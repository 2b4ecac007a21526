"""Requirements for training on an NVIDIA GPU: which are met, and remedies for those that are not."""

from __future__ import annotations

import os
import re
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which

MIN_TRITON, MAX_TRITON = (3, 6), (3, 9)
"""Major and minor numbers of the versions that the kernels were tested with; pyproject.toml asks for the same."""

TRITON_PACKAGES = ("triton", "pytorch-triton")
"""Package names of Triton; the second comes with builds of torch that are not releases."""

CUDA_SETUP = "`make setup TORCH_INDEX=https://download.pytorch.org/whl/cu128`"


@dataclass(frozen=True)
class Gpu:
    """The state of the requirements for training on a GPU.

    build         CUDA version for which torch was built; None: a CPU build
    name          name of the GPU that torch sees; None: it sees none
    triton        version of Triton; None: it is not installed
    has_compiler  whether there is a C compiler, with which Triton builds its kernel launchers
    has_headers   whether Python.h is installed, which that compiler needs
    """

    build: str | None
    name: str | None
    triton: str | None
    has_compiler: bool = True
    has_headers: bool = True

    @property
    def missing(self) -> str:
        """The missing requirements, as text; empty if nothing is missing."""
        return " and ".join(lack for lack, _ in self._lacks())

    @property
    def remedy(self) -> str:
        """The remedy for the first missing requirement, without a full stop; empty if nothing is missing."""
        return next((remedy for _, remedy in self._lacks()), "")

    def _lacks(self) -> Iterator[tuple[str, str]]:
        """Missing requirements of torch, then of Triton, each with its remedy."""
        if self.build is None:
            yield "torch is a CPU build", f"Install torch's CUDA build ({CUDA_SETUP})"
        elif self.name is None:
            driver = "whether its driver is as new as torch's CUDA"
            yield "torch sees no NVIDIA GPU", f"See whether `nvidia-smi` lists the GPU, and {driver}"
        if self.triton is None:
            yield "Triton is not installed", "Install Triton (in a checkout: `.venv/bin/pip install '.[gpu]'`)"
        elif not MIN_TRITON <= _numbers(self.triton) <= MAX_TRITON:
            remedy = "Install a torch that brings one of those, and do not change Triton alone"
            remedy += f" (`make clean`, then {CUDA_SETUP})"
            yield f"Triton is {self.triton}, where {triton_range()} are supported", remedy
        elif not self.has_compiler:
            remedy = "Install one and Python's headers (`apt install gcc python3-dev`); CC, if it is set, must name one"
            yield "Triton finds no C compiler", remedy
        elif not self.has_headers:
            yield "Triton finds no Python.h for its C compiler", "Install Python's headers (`apt install python3-dev`)"


def may_have_gpu() -> bool:
    """Whether this machine may have an NVIDIA GPU, without loading torch: False only if it certainly has none."""
    devices = Path("/dev")
    return not sys.platform.startswith("linux") or any(devices.glob("nvidia*")) or (devices / "dxg").exists()


def triton_range() -> str:
    """The supported versions of Triton, as text."""
    oldest, newest = (".".join(map(str, numbers)) for numbers in (MIN_TRITON, MAX_TRITON))
    return f"{oldest} to {newest}"


def find_gpu() -> Gpu:
    """The state of this machine's requirements.

    Raises:
        ImportError: torch is not installed.
    """
    import torch  # here, so that `intrasplat doctor` can import this module without torch

    name = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return Gpu(torch.version.cuda, name, _triton(), _has_compiler(), _has_headers())


def _triton() -> str | None:
    """The installed version of Triton, without loading it."""
    for name in TRITON_PACKAGES:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return None


def _numbers(triton: str) -> tuple[int, ...]:
    """The major and minor number of a version."""
    return tuple(int(number) for number in re.findall(r"\d+", triton)[:2])


def _has_compiler() -> bool:
    """Whether there is a compiler where Triton looks: it uses CC verbatim, without arguments, even if it is empty."""
    named = os.environ.get("CC")
    return any(which(name) for name in (("gcc", "clang") if named is None else (named,)))


def _has_headers() -> bool:
    """Whether there is a Python.h where Triton looks: the folder of Debian's own scheme has none."""
    scheme = sysconfig.get_default_scheme()
    folder = sysconfig.get_path("include", "posix_prefix" if scheme == "posix_local" else scheme)
    return (Path(folder) / "Python.h").is_file()
