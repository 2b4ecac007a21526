"""What an NVIDIA GPU takes to be trained on, whether it is there, and how to get what is not."""

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
"""Names under which Triton is installed; the second comes with builds of torch that are not releases."""

CUDA_SETUP = "`make setup TORCH_INDEX=https://download.pytorch.org/whl/cu128`"


@dataclass(frozen=True)
class Gpu:
    """What training on a GPU takes, as far as it is there.

    build         the CUDA version that torch was built for; None: it is a CPU build
    name          of the GPU that torch sees; None: it sees none
    triton        the version of Triton; None: it is not installed
    has_compiler  whether there is a C compiler, by which Triton makes what launches its kernels
    has_headers   whether Python.h is there, which that compiler reads
    """

    build: str | None
    name: str | None
    triton: str | None
    has_compiler: bool = True
    has_headers: bool = True

    @property
    def missing(self) -> str:
        """What is not there, in words; empty if nothing is missing."""
        return " and ".join(lack for lack, _ in self._lacks())

    @property
    def remedy(self) -> str:
        """What to do about what is missing first, without a full stop; empty if nothing is missing."""
        return next((remedy for _, remedy in self._lacks()), "")

    def _lacks(self) -> Iterator[tuple[str, str]]:
        """What torch lacks, then what Triton does, each with its remedy."""
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
    """Whether this machine may have an NVIDIA GPU, told without torch: False only if it surely has none."""
    devices = Path("/dev")
    return not sys.platform.startswith("linux") or any(devices.glob("nvidia*")) or (devices / "dxg").exists()


def triton_range() -> str:
    """The supported versions of Triton, in words."""
    oldest, newest = (".".join(map(str, numbers)) for numbers in (MIN_TRITON, MAX_TRITON))
    return f"{oldest} to {newest}"


def find_gpu() -> Gpu:
    """What there is on this machine.

    Raises:
        ImportError: torch is not installed.
    """
    import torch  # here, so that the doctor can read this file where it is missing

    name = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return Gpu(torch.version.cuda, name, _triton(), _has_compiler(), _has_headers())


def _triton() -> str | None:
    """The version of Triton that is installed, told without loading it."""
    for name in TRITON_PACKAGES:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return None


def _numbers(triton: str) -> tuple[int, ...]:
    """Major and minor number of a version."""
    return tuple(int(number) for number in re.findall(r"\d+", triton)[:2])


def _has_compiler() -> bool:
    """Whether there is a program where Triton looks: it takes CC as it is, without arguments, even if it is empty."""
    named = os.environ.get("CC")
    return any(which(name) for name in (("gcc", "clang") if named is None else (named,)))


def _has_headers() -> bool:
    """Whether there is a Python.h where Triton looks: Debian's own scheme names a folder that has none."""
    scheme = sysconfig.get_default_scheme()
    folder = sysconfig.get_path("include", "posix_prefix" if scheme == "posix_local" else scheme)
    return (Path(folder) / "Python.h").is_file()
