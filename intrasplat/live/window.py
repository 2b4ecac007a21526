"""The newest used frames of a feed, and the model that shows them: every frame has a basis of the motion to itself.

A basis is so narrow that at its own frame no other one counts. A frame's weights are thus the state of the Gaussians
in it, and training one frame leaves the others as they are, but for the canonical state that all share. A scene gets
wider bases (SCENE_WIDTH) between which motion is interpolated, with the same states at the frames.

Symbols: N Gaussians, S frames of a segment, 2 S slots, a slot for each frame; T frames of a scene, C = 14 channels.
Model time in the window is the number of the slot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.camera import to_camera
from intrasplat.clip import DepthClip
from intrasplat.live.pair import FeedPair
from intrasplat.poses.rigid import inverse
from intrasplat.scene.recorded_video import RecordedEye
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device, make_model
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR, LOG_SCALE, ROWS
from intrasplat.splat.model import FIRST_MOMENTS
from intrasplat.splat.step import Target, TrainingFrame
from intrasplat.train.targets import TrainingFrames, solid_depth_mm

SLOT_WIDTH = 0.2
"""Width of a basis in the window, in slots: a neighbour's value at a slot is 4e-6, and not evaluated."""
SCENE_WIDTH = 0.5
"""Width of a basis in a scene, in frames: half-way between two frames it is nearly linear."""
WEIGHT, SECOND_MOMENTS, STEPS = "motion.weight", "motion.second", "motion.steps"
ARRIVED_AT = "arrived_at"
"""Setting of a scene of a feed: UNIX times, s, at which its frames came in."""
RIGHT_EYE = "right_eye"
"""Setting of a scene of a feed: a RightEye of intrasplat/report.py."""
MOTION_EVERY = 3
"""Frames from one at which the error of the motion is measured to the next."""
BETWEEN = 1 / 128
"""The squared error half-way between two frames, as a share of that at a frame that is left out: 1 / 16 for smooth
motion without noise; phantoms show less."""
USUAL_PULL = 0.02
"""Share of its distance from the usual size that a Gaussian's log-scale loses with each frame. Without it Gaussians
become ever thinner: Adam's steps are as large for what no picture determines."""
MAX_COLOUR = 0.6 / SH_C0
"""Largest constant harmonic: a colour 0.1 beyond black and white."""
SIDES = (-0.5, 0.5)
"""Camera.side of the left and the right eye, for the gloss."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A used frame: the clip of this one frame, the pair's times, and both eyes' targets, left first.

    scale: optimiser units per mm of the targets.
    """

    clip: DepthClip
    source_s: float
    arrived_at: float
    sequence: int
    frames: tuple[TrainingFrame, ...]
    scale: float

    @classmethod
    def of(cls, clip: DepthClip, pair: FeedPair, scale: float) -> Moment:
        """The moment of a pair that was read as this clip. scale: optimiser units per mm."""
        frames = []
        for eye, side in zip(clip.eyes, SIDES, strict=True):
            frame = TrainingFrames(eye, [0], scale, side).frame(0)
            frames.append(replace(frame, make_target=partial(_same, frame.target)))
        return cls(clip, pair.source_s, pair.arrived_at, pair.sequence, tuple(frames), scale)

    def at(self, slot: int) -> Moment:
        """The moment in a slot of the window."""
        return replace(self, frames=tuple(replace(frame, t=float(slot)) for frame in self.frames))


def _same(target: Target) -> Target:
    return target


class WindowPictures:
    """The TrainingPictures of some moments, which are a scene's frames, in order."""

    def __init__(self, moments: Sequence[Moment]) -> None:
        first = moments[0].clip
        self.frames = range(len(moments))
        self.eyes = tuple(
            RecordedEye(eye.intrinsics, inverse(first.world_from_camera[0]) @ eye.world_from_camera[0])
            for eye in first.eyes
        )
        self._pictures = [[(eye.rgb[0], eye.tissue[0]) for eye in moment.clip.eyes] for moment in moments]

    @property
    def byte_count(self) -> int:
        """Their bytes in memory."""
        return sum(array.nbytes for moment in self._pictures for eye in moment for array in eye)

    def picture(self, eye: int, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """See TrainingPictures."""
        return self._pictures[frame][eye]


class Window:
    """The used frames of up to two segments, and the model. The first S are given up when all slots are taken."""

    def __init__(self, gaussians: Gaussians, first: Moment, segment_frames: int, device: Device = CPU) -> None:
        """A model in which the first moment is at rest."""
        slots, count = 2 * segment_frames, len(gaussians)
        motion = SharedBasis(
            torch.zeros(count, ROWS, slots), torch.arange(slots).float(), torch.full((slots,), SLOT_WIDTH)
        )
        camera = first.clip.intrinsics
        self.model = make_model(gaussians, motion, camera.width, camera.height, device)
        self.scale, self.segment_frames = first.scale, segment_frames
        self.moments = [first.at(0)]
        self._usual_size = float(gaussians.log_scale.median())

    @property
    def slot(self) -> int:
        """The newest frame's slot."""
        return len(self.moments) - 1

    @property
    def newest(self) -> Moment:
        return self.moments[-1]

    @property
    def is_full(self) -> bool:
        """Whether the first segment must be given up before the next frame."""
        return len(self.moments) == 2 * self.segment_frames

    def weights(self) -> torch.Tensor:
        """[2 S, C, N] the motion's weights by slot; a view."""
        return self.model.parameters()[WEIGHT]

    def give_up(self) -> None:
        """Forget the first segment. The motion's weights and Adam's moments of the others move to its slots.

        The mean of their weights becomes part of the canonical state: float16 loses small differences of large weights.
        """
        count, arrays = self.segment_frames, self.model.arrays()
        for name in (WEIGHT, FIRST_MOMENTS, SECOND_MOMENTS, STEPS):
            arrays[name][:count].copy_(arrays[name][count:].clone())
        mean = arrays[WEIGHT][:count].mean(0)
        arrays[WEIGHT][:count] -= mean
        arrays["canonical"] += mean
        self._usual_size = float(arrays["canonical"][LOG_SCALE].median())
        self.moments = [moment.at(slot) for slot, moment in enumerate(self.moments[count:])]

    def append(self, moment: Moment, moved: Sequence[tuple[slice, NDArray[np.float32]]] = ()) -> None:
        """Take the next frame, which starts as the newest one, but for what moved: [*, N] of some channels."""
        last, arrays = self.slot, self.model.arrays()
        for name in (WEIGHT, FIRST_MOMENTS, SECOND_MOMENTS, STEPS):
            arrays[name][last + 1].copy_(arrays[name][last])
        weight = arrays[WEIGHT][last + 1]
        for channels, change in moved:
            weight[channels] += torch.from_numpy(change).to(weight.device)
        self._restrain(arrays["canonical"], weight)
        self.moments.append(moment.at(last + 1))

    def _restrain(self, canonical: torch.Tensor, weight: torch.Tensor) -> None:
        """Restrain sizes and colours of a frame, by the canonical state [C, N]. weight: [C, N] the frame's."""
        size = canonical[LOG_SCALE] + weight[LOG_SCALE]
        canonical[LOG_SCALE] -= USUAL_PULL * (size - self._usual_size)
        colour = canonical[COLOUR] + weight[COLOUR]
        canonical[COLOUR] += colour.clamp(-MAX_COLOUR, MAX_COLOUR) - colour

    def shown(self) -> DepthClip:
        """The newest frame's left eye as the model shows it, with the recorded one where the model has nothing."""
        clip = self.newest.clip
        image = self.model.render(self.newest.frames[0].camera, float(self.slot))
        depth_mm = solid_depth_mm(image[3], image[4], self.scale)
        solid = depth_mm > 0
        rgb = np.clip(image[:3].transpose(1, 2, 0) * 255 + 0.5, 0, 255).astype(np.uint8)
        return replace(
            clip,
            rgb=np.where(solid[..., None], rgb, clip.rgb[0])[None],
            tissue=solid[None],
            depth_mm=depth_mm[None],
            depth_confidence=np.where(solid, np.uint8(255), np.uint8(0))[None],
            right=None,
        )

    def motion_error(self, end: int) -> float:
        """How far the motion between the first `end` frames may be wrong, in squared grey levels; 0 for two frames.

        It is in proportion to what frames differ by from the mean of the frames before and after them.
        """
        weights, errors = self.weights(), []
        for slot in range(1, end - 1, MOTION_EVERY):
            camera, tissue = self.moments[slot].frames[0].camera, self.moments[slot].clip.tissue[0]
            own = self.model.render(camera, float(slot))[:3, tissue].copy()
            learnt = weights[slot].clone()
            weights[slot] = (weights[slot - 1] + weights[slot + 1]) / 2
            errors.append(float(np.square(255 * (self.model.render(camera, float(slot))[:3, tissue] - own)).mean()))
            weights[slot] = learnt
        return BETWEEN * float(np.nanmean(errors)) if errors else 0.0

    def scene(self, end: int, seen: NDArray[np.float32], motion_error: float, *, seed: int = 0) -> TrainedScene:
        """The scene of the first `end` frames, as a copy. seen, motion_error: as in TrainedScene."""
        moments = self.moments[:end]
        count = len(moments)
        gaussians, motion = self.model.export(as_it_lies=True)
        assert isinstance(motion, SharedBasis)
        states = np.ascontiguousarray(motion.weight.permute(2, 1, 0)[:end].numpy())
        times = torch.arange(count).float() / count
        form = SharedBasis(torch.zeros(0, ROWS, count), times, torch.full((count,), SCENE_WIDTH / count))
        values = np.stack([form.basis(float(t)).double().numpy() for t in times])
        mixing = np.linalg.inv(values).astype(np.float32)
        weight = torch.from_numpy((mixing @ states.reshape(count, -1)).reshape(states.shape)).permute(2, 1, 0)
        clip = moments[0].clip
        assert clip.right is not None
        right_mm = to_camera(clip.right.world_from_camera[:1, :3, 3], clip.world_from_camera[0])[0].tolist()
        return TrainedScene(
            gaussians=gaussians,
            deformation=replace(form, weight=weight),
            intrinsics=clip.intrinsics,
            world_from_camera=np.concatenate([moment.clip.world_from_camera for moment in moments]),
            frame_times_s=np.array([moment.source_s for moment in moments]),
            units_per_mm=self.scale,
            preset="live",
            trained_t=tuple(times.tolist()),
            seen=torch.from_numpy(seen),
            right_eye_mm=tuple(right_mm),
            seed=seed,
            settings={
                ARRIVED_AT: [moment.arrived_at for moment in moments],
                RIGHT_EYE: clip.registration and clip.registration.model_dump(),
                "motion_error": motion_error,
            },
            pictures=WindowPictures(moments),
        )
