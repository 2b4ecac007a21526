"""The motion of the canonical Gaussians: FDM and ours, with one interface (base.Deformation).

| kind          | numbers per Gaussian | bases                                                    |
|---------------|----------------------|----------------------------------------------------------|
| fdm-gaussian  | 30 B                 | own centres and widths per Gaussian and channel, trained |
| shared        | 10 B                 | one fixed set for all                                    |

register_motion adds a motion from outside (docs/extending.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from torch import Tensor

from intrasplat.splat.deformation.base import AtRest, Deformation, LinearDeformation, add_offsets
from intrasplat.splat.deformation.fdm import FlexibleDeformation, GaussianFdm
from intrasplat.splat.deformation.shared import SharedBasis

__all__ = [
    "MOTIONS",
    "AtRest",
    "Deformation",
    "FlexibleDeformation",
    "GaussianFdm",
    "LinearDeformation",
    "SharedBasis",
    "add_offsets",
    "motion_named",
    "register_motion",
    "restore",
]

_MOTIONS: dict[str, type[Deformation]] = {GaussianFdm.kind: GaussianFdm, SharedBasis.kind: SharedBasis}
MOTIONS: Mapping[str, type[Deformation]] = MappingProxyType(_MOTIONS)
"""Every motion by its name in presets and in stored scenes."""


def register_motion(motion: type[Deformation]) -> None:
    """Register a motion by its kind, in this process. Registering it again changes nothing.

    Raises:
        ValueError: another motion has the kind.
    """
    if _MOTIONS.setdefault(motion.kind, motion) is not motion:
        raise ValueError(f"there is another deformation kind {motion.kind!r}")


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
        ValueError: the kind is unknown, or the tensors do not belong to it.
    """
    motion = motion_named(kind)
    try:
        return motion.from_tensors(tensors)
    except (KeyError, TypeError) as error:
        raise ValueError(f"tensors {sorted(tensors)} do not make a {kind} deformation") from error
