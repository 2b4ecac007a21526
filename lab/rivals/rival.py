"""A rival: a published method that learns from the left eye's training frames and renders any time and pose.

Symbols: F training frames, H W pixels. Lengths in mm of the clip's world.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.train.hooks import RenderedFrame


@dataclass(frozen=True, eq=False)
class Seen:
    """The training frames of the left eye as tensors on one device. A rival sees nothing else of the clip.

    rgb [F, H, W, 3] in [0, 1]; tissue [F, H, W] bool; depth_mm [F, H, W], 0 where it is not known or not tissue;
    t [F]; world_from_camera [F, 4, 4]
    """

    rgb: Tensor
    tissue: Tensor
    depth_mm: Tensor
    t: Tensor
    world_from_camera: Tensor
    intrinsics: Intrinsics

    @classmethod
    def of(cls, clip: DepthClip, train: Sequence[int], device: str = "cpu", dtype: torch.dtype = torch.float32) -> Seen:
        """Copies of the frames. Raises InputError if none has valid depth on tissue."""
        frames = list(train)
        tissue = torch.from_numpy(clip.tissue[frames])
        depth_mm = torch.from_numpy(clip.depth_mm[frames]) * tissue
        if not bool((depth_mm > 0).any()):
            problem = "no training frame has a valid depth on tissue."
            raise InputError("clip", problem, "Check the calibration and the mask polarity, or hold out fewer frames.")
        return cls(
            rgb=torch.from_numpy(clip.rgb[frames]).to(device, dtype) / 255,
            tissue=tissue.to(device),
            depth_mm=depth_mm.to(device, dtype),
            t=torch.from_numpy(clip.t[frames]).to(device, dtype),
            world_from_camera=torch.from_numpy(clip.world_from_camera[frames]).to(device, dtype),
            intrinsics=clip.intrinsics,
        )

    @property
    def with_tissue(self) -> list[int]:
        """The frames that show tissue."""
        return [frame for frame in range(len(self)) if bool(self.tissue[frame].any())]

    def __len__(self) -> int:
        return int(self.rgb.shape[0])


class Rival(ABC):
    """A method in training. All random numbers follow from its seed and the iteration.

    not_measured     which figures of a row it cannot have, and why
    published_steps  iterations of its paper, at which a run ends if its budget does not end it before
    optimizer        has all that is trained; its groups' rates are set before every step
    time_share       of a budget of seconds: how much is used when a step begins; 0 without one
    """

    not_measured: ClassVar[str]
    published_steps: ClassVar[int]
    optimizer: torch.optim.Optimizer
    seed: int
    time_share: float = 0.0

    @abstractmethod
    def loss(self, iteration: int, progress: float) -> Tensor:
        """The loss of an iteration (from 1); progress in [0, 1) says how much of the training is done. It may note what
        the iteration has found for later ones."""

    @abstractmethod
    def rates(self, progress: float) -> Sequence[float]:
        """The learning rate of each of the optimizer's groups."""

    @abstractmethod
    def render(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        """The tissue at model time t from a pose (mm) with a camera. Several threads may call it."""

    @property
    def gaussians(self) -> int:
        """How many there are; 0 where the method has none."""
        return 0

    def motion_mm(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
    ) -> NDArray[np.float32]:
        """[H, W, 3] mm, world: displacement up to t of what each pixel shows at t = 0; NaN where none is known."""
        del t, world_from_camera
        return np.full((intrinsics.height, intrinsics.width, 3), np.nan, np.float32)

    def step(self, iteration: int, progress: float) -> float:
        """One iteration; returns its loss.

        Raises:
            TrainingDiverged: of the Gaussians, a place is not finite or all are transparent.
        """
        for group, rate in zip(self.optimizer.param_groups, self.rates(progress), strict=True):
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss = self.loss(iteration, progress)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return float(loss.detach())

    def parameters(self) -> list[Tensor]:
        """All that is trained."""
        return [each for group in self.optimizer.param_groups for each in group["params"]]

    @property
    def parameter_count(self) -> int:
        """How many numbers are trained."""
        return sum(each.numel() for each in self.parameters())

    def generator(self, iteration: int) -> torch.Generator:
        """The random numbers of an iteration; 0 stands for the start.

        They are drawn on the CPU, so that every device gets the same ones.
        """
        return torch.Generator().manual_seed(1_000_003 * self.seed + iteration)


def decayed(first_and_last: tuple[float, float], share: float) -> float:
    """A value that decays exponentially from the first to the last, at a share of the training in [0, 1]."""
    first, last = first_and_last
    return first * math.exp(share * math.log(last / first))


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Torch's random numbers on the CPU within the block follow from the seed; later ones do not."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch computes on so many threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
