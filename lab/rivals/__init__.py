"""The systems of the paper's table 1, written anew from descriptions of their methods. They are measured beside ours,
and that is all they are for: no scene of theirs is stored or served.

Read in this order: rival (what a rival is), fields (what radiance fields share), endonerf, planes, proposals, lerplane,
adaptive_density, displacement, endogaussian, run (how one is trained and judged). docs/rivals.md says which settings
are published, which are ours, and why.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from intrasplat.splat.backend import Device
from lab.rivals.endogaussian import EndoGaussian
from lab.rivals.endonerf import EndoNerf
from lab.rivals.lerplane import LerPlane
from lab.rivals.run import Make

RIVAL_SYSTEMS: Mapping[str, Make] = MappingProxyType(
    {"endonerf": EndoNerf, "lerplane": LerPlane, "endogaussian": EndoGaussian}
)
"""By the name of their series."""
RIVAL_BUDGET_S = 1800.0
"""Seconds of training if nothing else is asked for; what was published takes a GPU up to six hours."""
RAY_BY_RAY = frozenset({"endonerf", "lerplane"})
CPU_STEP_PX, CPU_COLUMNS = 5, 64
"""On a processor every 5th pixel of every 5th row is scored, and of rows wider than 320 pixels about 64: with EndoNeRF
a whole picture of 160x128 takes two cores 22 to 24 s."""


def scored_step_px(series: str, device: Device, width: int) -> int:
    """The step in pixels, across and down, of the lattice that a system is scored on (lab/evaluate/thinned.py), in a
    picture so many pixels wide: more than 1 where rays take long."""
    return max(CPU_STEP_PX, width // CPU_COLUMNS) if series in RAY_BY_RAY and device.kind == "cpu" else 1
