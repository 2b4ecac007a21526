"""Run as a program: compile every kernel that matching on a GPU launches, as tests/worker/raster/cuda_probe.py does."""

from __future__ import annotations

import json

import torch
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from tests.worker.raster.cuda_probe import NoDevice, compile_launch, compiled
from worker.stereo.cuda.matching import filled, path_sums, winners

RANGES = ((1, 20), (7, 48), (-20, 100))
"""Least disparity, of which Triton makes a constant where it is 1, and number of them: 32, 64 and 128 lanes."""


def main() -> None:
    driver.set_active(NoDevice())
    JITFunction.run = compile_launch
    image = torch.zeros(2, 37, 75, dtype=torch.uint8)
    for low, count in RANGES:
        winners(path_sums(image, image, low, count), low)
    filled(image.float(), image.float(), image)
    print(json.dumps(list(compiled.values())))


if __name__ == "__main__":
    main()
