"""How the canonical Gaussians move: FDM and its alternatives, one promise for all (base.Deformation).

| kind                       | numbers per Gaussian | bases                                                      |
|----------------------------|----------------------|------------------------------------------------------------|
| fdm-gaussian, fdm-quartic  | 30 B                 | own centres and widths per Gaussian and channel, trained   |
| shared                     | 10 B                 | one fixed set for all                                      |
| pfs                        | 10 B                 | polynomials and harmonics                                  |
| hexplane                   | 0                    | six shared feature planes at two resolutions and a network |

MOTIONS is the registry. A new motion is a file here and a line there (docs/extending.md).
"""

from __future__ import annotations

from torch import Tensor

from intrasplat.splat.deformation.base import AtRest, Deformation, LinearDeformation, add_offsets
from intrasplat.splat.deformation.fdm import FlexibleDeformation, GaussianFdm, QuarticFdm
from intrasplat.splat.deformation.hexplane import HexPlane
from intrasplat.splat.deformation.polynomial import PolynomialFourier
from intrasplat.splat.deformation.shared import SharedBasis

__all__ = [
    "MOTIONS",
    "AtRest",
    "Deformation",
    "FlexibleDeformation",
    "GaussianFdm",
    "HexPlane",
    "LinearDeformation",
    "PolynomialFourier",
    "QuarticFdm",
    "SharedBasis",
    "add_offsets",
    "motion_named",
    "restore",
]

MOTIONS: dict[str, type[Deformation]] = {
    GaussianFdm.kind: GaussianFdm,
    QuarticFdm.kind: QuarticFdm,
    SharedBasis.kind: SharedBasis,
    PolynomialFourier.kind: PolynomialFourier,
    HexPlane.kind: HexPlane,
}
"""Every motion by its name in presets and in stored scenes."""


def motion_named(kind: str) -> type[Deformation]:
    """The motion of this name.

    Raises:
        ValueError: there is none.
    """
    if kind not in MOTIONS:
        raise ValueError(f"deformation kind {kind!r} is not one of {', '.join(MOTIONS)}")
    return MOTIONS[kind]


def restore(kind: str, tensors: dict[str, Tensor]) -> Deformation:
    """The motion whose kind, parameters() and constants() were stored.

    Raises:
        ValueError: a kind that is not known, or tensors that do not make one of it.
    """
    motion = motion_named(kind)
    try:
        return motion.from_tensors(tensors)
    except (KeyError, TypeError) as error:
        raise ValueError(f"tensors {sorted(tensors)} do not make a {kind} deformation") from error
