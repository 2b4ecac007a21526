"""How the canonical Gaussians move: FDM and ours, one promise for all (base.Deformation).

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

from worker.model.deformation.base import (
    AtRest,
    Deformation,
    LinearDeformation,
    add_offsets,
)
from worker.model.deformation.fdm import FlexibleDeformation, GaussianFdm
from worker.model.deformation.shared import SharedBasis

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
    """Make a motion known by its kind, for this process. To register it again changes nothing.

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
        ValueError: a kind that is not known, or tensors that do not make one of it.
    """
    motion = motion_named(kind)
    try:
        return motion.from_tensors(tensors)
    except (KeyError, TypeError) as error:
        raise ValueError(f"tensors {sorted(tensors)} do not make a {kind} deformation") from error
