"""Compile every kernel that matching on a GPU launches; run as a program, as tests/intrasplat/splat/cuda_probe.py."""

from __future__ import annotations

import json

import torch
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from intrasplat.stereo.cuda.matching import filled, path_sums, winners
from tests.intrasplat.splat.cuda_probe import NoDevice, compile_launch, compiled

RANGES = ((1, 20), (-7, 48))
"""Least disparity and number of them: 32 and 64 lanes."""
SIZES = ((2, 37, 75), (1, 32, 64))
"""The second is of numbers that Triton likes to treat apart: 1 and multiples of 16."""


def main() -> None:
    driver.set_active(NoDevice())
    JITFunction.run = compile_launch
    for size in SIZES:
        image = torch.zeros(size, dtype=torch.uint8)
        for low, count in RANGES:
            winners(path_sums(image, image, low, count), low)
        filled(image.float(), image.float(), image)
    print(json.dumps(list(compiled.values())))


if __name__ == "__main__":
    main()
