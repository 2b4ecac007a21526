"""How the canonical Gaussians move: FDM and its rivals, one promise for all (base.Deformation).

| kind                       | numbers a Gaussian | bases                                                     |
|----------------------------|--------------------|-----------------------------------------------------------|
| fdm-gaussian, fdm-quartic  | 30 B               | own centres and widths a Gaussian and channel, trained    |
| shared                     | 10 B               | one fixed set for all                                     |
| pfs                        | 10 B               | polynomials and harmonics                                 |
| hexplane                   | 0                  | six shared feature planes at two resolutions and a network |
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from worker.model.deformation.base import CHANNELS, LOG_SCALE, MEAN, QUATERNION, Deformation, add_offsets
from worker.model.deformation.fdm import FlexibleDeformation
from worker.model.deformation.hexplane import HexPlane
from worker.model.deformation.polynomial import PolynomialFourier
from worker.model.deformation.shared import SharedBasis

__all__ = [
    "CHANNELS",
    "LOG_SCALE",
    "MEAN",
    "QUATERNION",
    "Deformation",
    "FlexibleDeformation",
    "HexPlane",
    "PolynomialFourier",
    "SharedBasis",
    "add_offsets",
    "restore",
]

_FROM_TENSORS: dict[str, Callable[[dict[str, Tensor]], Deformation]] = {
    "fdm-gaussian": lambda named: FlexibleDeformation(**named, form="gaussian"),
    "fdm-quartic": lambda named: FlexibleDeformation(**named, form="quartic"),
    "shared": lambda named: SharedBasis(**named),
    "pfs": lambda named: PolynomialFourier(**named),
    "hexplane": HexPlane.from_tensors,
}


def restore(kind: str, tensors: dict[str, Tensor]) -> Deformation:
    """The model whose kind, parameters() and constants() were stored.

    Raises:
        ValueError: a kind that is not known, or tensors that do not make one of it.
    """
    if kind not in _FROM_TENSORS:
        raise ValueError(f"deformation kind {kind!r} is not one of {', '.join(_FROM_TENSORS)}")
    try:
        return _FROM_TENSORS[kind](tensors)
    except (KeyError, TypeError) as error:
        raise ValueError(f"tensors {sorted(tensors)} do not make a {kind} deformation") from error
