"""All numbers that change from step to step, in one block of memory on the device; the launches of a step never change.

The host writes a step's numbers into a row of page-locked memory, which is copied to the block in order with the
launches, without waiting. A row is kept until its step is known to be made; one that exceeded the capacity is resent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from intrasplat.splat.layout import COLOUR, GLOSS, LOG_SCALE, MEAN, OPACITY_ROW, QUATERNION, VALUES
from intrasplat.splat.optimize import StepRates, adam_step

ALIGNMENT = 16
"""Bytes: a field starts at a multiple of so many, because kernels are compiled for that."""
ADAM = ("slot", "size", "floor", "betas")
"""The adam_fields that the update of everything but the harmonics reads, in the order of its arguments."""
_TYPES = {"float": torch.float32, "int": torch.int32, "double": torch.float64}


@dataclass(frozen=True)
class ControlField:
    """The shape and the type of one part of the block."""

    shape: tuple[int, ...]
    kind: Literal["float", "int", "double"] = "float"

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * _TYPES[self.kind].itemsize


class Control:
    """The block and its rows on the host.

    values  every field by name, on the device: views of the block
    rows    the fields of each row by name: NumPy views, to be written before the row is sent
    """

    def __init__(self, fields: Mapping[str, ControlField], rows: int, device: torch.device) -> None:
        starts, size = {}, 0
        for name, field in fields.items():
            starts[name] = size
            size += -(-field.bytes // ALIGNMENT) * ALIGNMENT
        self._block = torch.zeros(size, dtype=torch.uint8, device=device)
        self._ring = torch.zeros(rows, size, dtype=torch.uint8, pin_memory=device.type == "cuda")
        self.values: dict[str, Tensor] = {}
        self.rows: list[dict[str, np.ndarray]] = [{} for _ in range(rows)]
        for name, field in fields.items():
            part, kind = slice(starts[name], starts[name] + field.bytes), _TYPES[field.kind]
            self.values[name] = self._block[part].view(kind).view(field.shape)
            for k, row in enumerate(self.rows):
                row[name] = self._ring[k, part].view(kind).view(field.shape).numpy()

    def send(self, row: int) -> None:
        """Copy a row to the block, for the launches that follow."""
        self._block.copy_(self._ring[row], non_blocking=True)


def adam_fields() -> dict[str, ControlField]:
    """Adam's numbers of a step for all parameters but the motion's: the step's place in the report; step sizes of the
    state's rows and the opacity, and of the higher harmonics; the floor they share; the decays of the moments."""
    return {
        "slot": ControlField((1,), "int"),
        "size": ControlField((VALUES,)),
        "rest_size": ControlField((1,)),
        "floor": ControlField((1,)),
        "betas": ControlField((2,)),
    }


def write_adam(row: Mapping[str, np.ndarray], slot: int, rates: StepRates, iteration: int) -> None:
    """Fill adam_fields for an iteration, counted from 1."""
    row["slot"][0] = slot
    unit = adam_step(1.0, rates, iteration)
    size = row["size"]
    size[MEAN], size[QUATERNION], size[LOG_SCALE] = rates.mean, rates.quaternion, rates.log_scale
    size[COLOUR], size[GLOSS], size[OPACITY_ROW] = rates.colour, rates.gloss, rates.opacity
    size *= np.float32(unit.size)
    row["rest_size"][0] = rates.sh_rest * unit.size
    row["floor"][0] = unit.floor
    row["betas"][:] = rates.beta1, rates.beta2
