"""The CUDA backend's kernels pass the compiler for an H200's generation, and fit into its registers."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from tests.intrasplat.probes import kernels_compiled_by

SHARED_BYTES = 48 * 1024
"""What every GPU gives a program without being asked for more."""
SPILLED_BYTES = {"update_linear": 8} if version("triton").startswith("3.6.") else {}
"""Triton 3.6 spills two numbers of it, on two frames; 3.9 spills none."""


def test_every_kernel_compiles_for_sm_90_and_keeps_its_numbers_in_registers(triton_cache: Path) -> None:
    kernels = kernels_compiled_by("tests.intrasplat.splat.cuda_probe", triton_cache)
    assert {each["kernel"] for each in kernels} == {
        "project", "fill_slots", "blend", "sum_slots", "project_backward",
        "deform_linear", "update_linear", "deform_fdm", "update_fdm",
        "colour_from_sh", "colour_from_sh_backward", "update_rest",
    }  # fmt: skip
    for each in kernels:
        assert each["stack"] <= SPILLED_BYTES.get(each["kernel"], 0), f"spills: {each}"
        assert each["local"] == 0, f"spills: {each}"
        assert each["shared"] <= SHARED_BYTES, each
