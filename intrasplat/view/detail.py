"""What a model misses of the recorded frames, carried to a view.

The residual of a training frame is its recorded picture less the model's view of it, in the model's steady light. A
pixel of a view shows a point of the tissue. The model's own motion tells where this point was at the two training
frames nearest in time, and depth whether an eye saw it there. Their residuals are blended by nearness in time.

What both eyes miss alike belongs to the tissue and is added from every side. What one of them misses alone, such as a
highlight that the model blurs, is added near that eye only.

Symbols: H W pixels of the view, h w of a recorded picture, N Gaussians.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.machine.parts import Parts
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import TrainingPictures
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.confidence import followed
from intrasplat.view.recorded_light import EndoscopeLight
from intrasplat.view.residual import Points, Residual, flow_between
from intrasplat.view.smoky import smoke_share
from intrasplat.view.transfer import ONE

if TYPE_CHECKING:
    from intrasplat.view.renderer import SceneRenderer

Floats = NDArray[np.float32]
Pose = NDArray[np.float64]

SHARED_DEG, LONE_DEG, OWN = 12.0, 6.0, 0.5
"""Standard deviations of the weights over the angle between the view's ray and the eye's: of what both eyes miss; of
what an eye without another misses; and of what one of two eyes misses alone, as a share of the angle between them."""
AGREEMENT_PX = 9
"""Side of the square in which the eyes' residuals are compared."""
NEGLIGIBLE = 0.02
"""A smaller weight is 0."""
CACHED = 6
"""Residuals in memory for a scene: of three moments with two eyes."""
EDGE_PX = 5
"""Residuals fade over half as many pixels towards what is masked, so that none appears at once where its edge moves."""
NOISE = 1.75 / 255
"""A residual of this root mean square or less is noise of the camera and loss of the coding, and fades: a model that
misses nothing leaves 1.5 to 1.75 levels of 255, others 2.6 and more."""
MIN_TRANSMISSION, MIN_LIGHT = 0.3, 0.2
"""Residuals behind smoke, or in a dark border, are noise where less of the light is left."""


Neighbours = list[tuple[int, float]]
Residuals = dict[tuple[int, int], Residual]


@dataclass(frozen=True, eq=False)
class Added:
    """What a view gets from the recorded frames.

    rgb     [H, W, 3] to be added to its colours, in the model's steady light
    weight  [H, W] in [0, 1], how much of what the recorded frames show of a pixel reaches it
    """

    rgb: Floats
    weight: Floats

    @classmethod
    def nothing(cls, size: tuple[int, ...]) -> Added:
        """For a view of size [H, W]."""
        return cls(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))

    def share(self, depth_mm: Floats) -> float:
        """Of the solid pixels of a view [H, W] with that depth, the share that gets something."""
        return float(self.weight.sum()) / max(int(np.count_nonzero(depth_mm)), 1)


class Detail:
    """The residuals of a scene's training frames. Several threads may use it."""

    def __init__(self, scene: TrainedScene, pictures: TrainingPictures) -> None:
        self._scene, self._pictures = scene, pictures
        trained = set(scene.trained_frames)
        self._frames = [frame for frame in pictures.frames if frame in trained]
        self._opacity = torch.sigmoid(scene.gaussians.opacity_logit).numpy()
        self._residuals: OrderedDict[tuple[int, int], Residual] = OrderedDict()
        self._flows: OrderedDict[tuple[int, int, int], Floats] = OrderedDict()
        self._lock = Lock()

    def added(
        self,
        renderer: SceneRenderer,
        t: float,
        world_from_camera: Pose,
        lens: Intrinsics,
        depth_mm: Floats,
        *,
        highlights: bool = True,
    ) -> Parts[Added]:
        """What a view at model time t gets.

        Args:
            depth_mm: [H, W] camera z of the view; 0 where nothing is solid.
            highlights: whether to add light that one of two eyes misses alone.

        Raises:
            SceneError: the recorded pictures are missing or damaged.
        """
        view = Points(world_from_camera, lens, depth_mm)
        poses = [self._eye_pose(eye, t) for eye in range(len(self._pictures.eyes))]
        angles = [view.squared_angle(pose) for pose in poses]
        lone = np.float32(np.deg2rad(LONE_DEG) ** 2)
        between = lone if len(poses) == 1 else np.float32(OWN**2) * view.squared_angle(poses[0], poses[1])
        own = [np.exp(each / (-2 * np.maximum(between, np.float32(1e-7)))) for each in angles]
        shared = np.exp(np.minimum.reduce(angles) / np.float32(-2 * np.deg2rad(SHARED_DEG) ** 2))
        nearest = int(np.argmax([float(each.mean()) for each in own]))
        is_own = float(own[nearest].min()) > 1 - NEGLIGIBLE
        is_dimmed = not highlights and len(poses) > 1
        if is_dimmed and is_own:  # the other eye tells only what both miss
            own = [each if eye == nearest else np.zeros_like(each) for eye, each in enumerate(own)]
            is_own = False
        used = [nearest] if is_own else range(len(own)) if float(shared.max()) > NEGLIGIBLE else ()
        totals = {eye: np.zeros((*depth_mm.shape, 4), np.float32) for eye in used}
        neighbours = self._neighbours(t) if used else []
        residuals: Residuals = {}
        for eye, (frame, _) in itertools.product(used, neighbours):
            residuals[eye, frame] = yield from self._residual(renderer, eye, frame)
        means_mm = [residuals[nearest, frame].means_mm for frame, _ in neighbours]
        moved_mm = view.motion_mm(_centres_mm(renderer, t), means_mm, self._opacity) if neighbours else ()
        yield
        for eye, total in totals.items():
            ways_mm = moved_mm
            if len(neighbours) == 2:
                ways_mm = self._corrected(view, eye, neighbours, residuals, moved_mm)
                yield
            for (frame, weight), way_mm in zip(neighbours, ways_mm, strict=True):
                view.carry(residuals[eye, frame], way_mm, weight, total)
                yield
        if not used:
            return Added.nothing(depth_mm.shape)
        found = {eye: (total[..., :3], total[..., 3]) for eye, total in totals.items()}
        return Added(
            *found[nearest]
            if is_own
            else _together(found, list(map(view.finer, own)), view.finer(shared), is_dimmed=is_dimmed)
        )

    def _eye_pose(self, eye: int, t: float) -> Pose:
        return endoscope_pose(self._scene, t) @ self._pictures.eyes[eye].left_from_eye

    def _neighbours(self, t: float) -> Neighbours:
        """The training frames before and after model time t, and their weights: together 1 if motion is followed."""
        frames, place = self._frames, t * self._scene.frame_count
        after = bisect_right(frames, place + 1e-6)
        if after == 0 or after == len(frames):
            return [(frames[min(after, len(frames) - 1)], 1.0)] if frames else []
        before, behind = frames[after - 1], frames[after]
        share, known = min(max((place - before) / (behind - before), 0.0), 1.0), followed(self._scene, t)
        weights = (before, known * (1 - share)), (behind, known * share)
        return [(frame, weight) for frame, weight in weights if weight > 1e-6]

    def _corrected(
        self, view: Points, eye: int, neighbours: Neighbours, residuals: Residuals, moved_mm: Sequence[Floats]
    ) -> list[Floats]:
        """The motion [m, n, 3] to two frames, after which their pictures of an eye show the same where they meet.

        The flow between the pictures is what the model's motion leaves. Each frame gets of it what the other weighs.
        """
        (before, weight), (after, other) = neighbours
        first, second = residuals[eye, before], residuals[eye, after]
        with self._lock:
            flow = self._flows.get((eye, before, after))
        if flow is None:
            flow = flow_between(first, second, self._opacity)
            with self._lock:
                self._flows[eye, before, after] = flow
                while len(self._flows) > CACHED:
                    self._flows.popitem(last=False)
        apart_px, share = view.apart_px(first, moved_mm[0], flow), np.float32(other / (weight + other))
        return [
            view.shifted(first, moved_mm[0], -share * apart_px),
            view.shifted(second, moved_mm[1], (1 - share) * apart_px),
        ]

    def _residual(self, renderer: SceneRenderer, eye: int, frame: int) -> Parts[Residual]:
        with self._lock:
            found = self._residuals.get((eye, frame))
            if found is not None:
                self._residuals.move_to_end((eye, frame))
                return found
        found = yield from self._measured(renderer, eye, frame)
        with self._lock:
            self._residuals[eye, frame] = found
            while len(self._residuals) > CACHED:
                self._residuals.popitem(last=False)
        return found

    def _measured(self, renderer: SceneRenderer, eye: int, frame: int) -> Parts[Residual]:
        scene, lens, t = self._scene, self._pictures.eyes[eye].lens, frame / self._scene.frame_count
        pose = self._eye_pose(eye, t)
        recorded, tissue = self._pictures.picture(eye, frame)
        height, width = tissue.shape
        yield
        image, _ = renderer.layers(t, pose, lens)
        yield
        depth_mm = solid_depth_mm(image[3], image[4], scene.units_per_mm)
        steady, is_lit = recorded * np.float32(1 / 255), np.ones_like(tissue)
        if scene.veil is not None:
            arrives = 1 - smoke_share(scene, t, depth_mm, (lens, pose))
            is_lit &= arrives > MIN_TRANSMISSION
            airlight = scene.veil.airlight
            steady = (steady - airlight) / np.maximum(arrives, np.float32(MIN_TRANSMISSION))[..., None] + airlight
        factors = EndoscopeLight(scene, t, pose, lens).factors(depth_mm)
        if factors is not None:
            is_lit &= np.broadcast_to(factors, steady.shape).min(-1) > MIN_LIGHT
            steady = steady / np.maximum(factors, np.float32(MIN_LIGHT))
        valid = _faded(tissue & is_lit & (depth_mm > 0))
        missed = np.clip(steady - image[:3].transpose(1, 2, 0), -1, 1) * valid[..., None]
        power = float(np.vdot(missed, missed)) / max(3 * float(np.vdot(valid, valid)), 1.0)
        shown = min(max(power / NOISE**2 - 1, 0.0), 1.0)
        planes = np.zeros((height + 2, width + 2, 4), np.int16)
        planes[1:-1, 1:-1, :3] = np.rint(missed * np.float32(shown * ONE))
        planes[1:-1, 1:-1, 3] = valid * np.float32(ONE)
        depth_mm = np.asarray(cv2.copyMakeBorder(depth_mm, 1, 1, 1, 1, cv2.BORDER_REPLICATE), np.float32)
        grey = cv2.cvtColor(np.rint(np.clip(steady, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        return Residual(planes, depth_mm, np.asarray(grey, np.uint8), lens, pose, _centres_mm(renderer, t))


def detail_bytes(scene: TrainedScene) -> int:
    """The most bytes that a scene's residuals take in memory."""
    k, per_pixel, per_gaussian = scene.intrinsics, 13, 12
    size = per_pixel * (k.width + 2) * (k.height + 2) + per_gaussian * len(scene.gaussians)
    return 0 if scene.pictures is None else CACHED * size


def _faded(valid: NDArray[np.bool_]) -> Floats:
    """[h, w] 1 where pixels are valid, falling to 0 within EDGE_PX of those that are not."""
    inner = cv2.erode(valid.view(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    return np.asarray(np.maximum(2 * cv2.blur(inner, (EDGE_PX, EDGE_PX)) - 1, 0) * inner, np.float32)


def _centres_mm(renderer: SceneRenderer, t: float) -> Floats:
    """[3, N] the Gaussians' centres at model time t, world."""
    return np.ascontiguousarray(renderer.means_mm(t).T, np.float32)


def _together(
    means: dict[int, tuple[Floats, Floats]], own: list[Floats], shared: Floats, *, is_dimmed: bool = False
) -> tuple[Floats, Floats]:
    """R G B [H, W, 3], times weight, and weight [H, W] of all eyes together.

    Args:
        means: the same of each eye.
        own, shared: [H, W] weights of what each eye misses alone, and of what both miss.
        is_dimmed: add nothing brighter that one eye misses alone.
    """
    if len(means) == 1:
        ((rgb, weight),) = means.values()
        return rgb * own[0][..., None], weight * own[0]
    (left, left_weight), (right, right_weight) = means.values()
    both = left_weight * right_weight
    alike = _agreement(left, right, both)
    common = (alike * both / 2)[..., None] * (left + right)
    near = own[0] + own[1]
    scale = 1 / np.maximum(near, 1)
    alone = [(each * scale)[..., None] * (rgb - common) for each, rgb in zip(own, (left, right), strict=True)]
    lone = alone[0] + alone[1]
    rgb = np.maximum(shared, np.minimum(near, 1))[..., None] * common + (np.minimum(lone, 0) if is_dimmed else lone)
    weight = np.maximum(shared * alike * both, scale * (own[0] * left_weight + own[1] * right_weight))
    return rgb, weight


def _agreement(left: Floats, right: Floats, both: Floats) -> Floats:
    """[H, W] in [0, 1]: share of the eyes' mean residual that they have in common, around each pixel."""
    side = (AGREEMENT_PX, AGREEMENT_PX)
    product = cv2.blur(both * (left * right).sum(-1), side)
    power = cv2.blur(both * ((left * left).sum(-1) + (right * right).sum(-1)) / 2, side)
    correlation = np.clip(product / (power + np.float32(1e-7)), 0, 1)
    return np.asarray(2 * correlation / (1 + correlation), np.float32)
