"""Research variants of `paper`, each of which differs in one thing. No service and no page offers them.

| preset         | instead of what `paper` does                                       | its file      |
|----------------|--------------------------------------------------------------------|---------------|
| paper-released | FDM as the released code computes it                               | quartic.py    |
| paper-wide     | bases that start as wide as 0.6 of their spacing                   |               |
| pfs            | polynomials and Fourier terms; Deform3DGS compares with them       | polynomial.py |
| hexplane       | six feature planes and a network; Deform3DGS compares with them    | hexplane.py   |
| without_mapf   | points of the first frame alone; the paper's ablation              |               |

register_variants() makes them known to a process, with the motions that they need. Whoever measures them calls it, and
whoever loads a scene of theirs.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from worker.evaluate.variants.hexplane import HexPlane
from worker.evaluate.variants.polynomial import PolynomialFourier
from worker.evaluate.variants.quartic import QuarticFdm
from worker.fusion import FusionSettings
from worker.methods.method import Departure, Preset, departing
from worker.methods.paper import PAPER
from worker.methods.registry import register_presets
from worker.model.deformation import register_motion

_DEPARTURES = (
    Departure("paper-released", {"deformation": QuarticFdm.kind}),
    Departure("paper-wide", {"start_width": 0.6 / 16}),
    Departure("pfs", {"deformation": PolynomialFourier.kind, "start_width": None}),
    Departure("hexplane", {"deformation": HexPlane.kind, "bases": 0, "start_width": None}),
    Departure("without_mapf", {"fusion": FusionSettings(mode="reference_only")}),
)


def register_variants() -> Mapping[str, Preset]:
    """Register the motions and presets of all variants in this process; the presets by name. May be called again."""
    for motion in (QuarticFdm, PolynomialFourier, HexPlane):
        register_motion(motion)
    variants = {each.name: departing(PAPER, [each], each.name) for each in _DEPARTURES}
    register_presets(*variants.values())
    return MappingProxyType(variants)
