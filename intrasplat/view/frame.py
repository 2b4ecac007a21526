"""Frames of a stored scene: any time, any pose, any pinhole camera; colour, depth and how far to trust each pixel.

N Gaussians, H W pixels. Scenes keep their kernels' buffers between frames, so the second frame of a size is fast.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from threading import Lock, RLock

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import MAX_JUDGED_PIXELS
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.cpu.threads import beside
from intrasplat.splat.layout import COLOUR_ROW
from intrasplat.splat.metrics import COVERED_ALPHA
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS, solid_depth_mm
from intrasplat.view.camera import as_recorded, endoscope_pose, view_camera
from intrasplat.view.confidence import confidence, evidence, seen_from_endoscope
from intrasplat.view.depth_range import DepthRange
from intrasplat.view.out_of_view import OutOfView
from intrasplat.view.unseen import blended_values, unseen_pixels

FAR_POSE = 0.35
"""Distance from the nearest trained pose, in median depths, beyond which the frame carries a warning, because it shows
sides that the clip never saw."""
LOW_TRUST, MAX_LOW_SHARE = 0.1, 0.1
"""A frame warns when more than this share of its pixels show Gaussians that are trusted less, as seen by the clip."""
HARDLY_SEEN = "More than a tenth of this view was hardly seen in the clip; see layer=confidence."
MAX_UNSEEN_SHARE = 0.05
"""A frame warns when more than this share of its pixels is unseen."""
HIGHLIGHTS_STAY = "This scene was taught by one eye, so its highlights are not known apart: they stay."
COARSE = "This picture is coarse, because a job trains and time is short. It becomes sharp when the view rests."
MAX_JUDGED_SIDE = 8192
"""If they are so many, at most so many along a side: as many as a caller may ask for."""
AS_FINE = 0.02
"""A picture whose pixels are by no more larger or smaller than the recording's is judged in its own."""
MOST = 0.5
"""Of a pixel: more of it decides."""
PART_PIXELS = 1 << 18
"""Pixels between two pauses of a large render."""
LARGE_PIXELS = 1 << 19
"""What takes all pixels of more than these at once is done on another thread, and pauses go on meanwhile."""
ROUNDING = 1e-6
"""Model time by which t may exceed the last frame's without a warning: a decimal fraction may round i / T."""


def no_pause() -> None:
    """What a render does between its parts if nobody waits."""


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view.

    rgb        [H, W, 3] uint8
    depth_mm   [H, W] float32, camera z, 0 where nothing solid is
    unseen     [H, W] bool: no training frame saw what is shown here; the other layers hold the model's guess
    unseen_share   of the view, in [0, 1]
    warnings   what to distrust about this frame, and what to know of it

    Confidence, unseen_share and warnings do not depend on how many pixels show the view (docs/conventions.md, "Size of
    a picture").
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    unseen_share: float
    warnings: tuple[Notice, ...]
    _confidence: Callable[[], NDArray[np.float32]]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """[H, W] float32 in [0, 1]: how likely colour and depth are right (confidence.py); 0 where nothing solid is.

        Computed when it is first asked for: from another pose than the endoscope's it takes a second render.
        """
        return self._confidence()

    def enlarged(self, width: int, height: int) -> View:
        """The frame in more pixels, with a notice that says so."""
        size = (width, height)
        rgb = np.asarray(cv2.resize(self.rgb, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        depth_mm = np.asarray(cv2.resize(self.depth_mm, size, interpolation=cv2.INTER_NEAREST), np.float32)
        unseen = cv2.resize(self.unseen.view(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        likely = self._confidence

        def confidence() -> NDArray[np.float32]:
            return np.asarray(cv2.resize(likely(), size, interpolation=cv2.INTER_LINEAR), np.float32)

        warnings = (*self.warnings, Notice.info(NoticeCode.COARSE, COARSE))
        return View(rgb, depth_mm, unseen, self.unseen_share, warnings, confidence)

    def reduced(self, width: int, height: int) -> View:
        """The frame in fewer pixels: each is the mean of those it covers, as most of them are solid and seen or not."""

        def mean(layer: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.floating]:
            return np.asarray(cv2.resize(layer, (width, height), interpolation=cv2.INTER_AREA))

        solid = mean((self.depth_mm > 0).astype(np.float32))
        covered, safe = solid >= MOST, np.maximum(solid, MOST)
        depth_mm = np.where(covered, mean(self.depth_mm) / safe, 0).astype(np.float32)
        unseen, likely = mean(self.unseen.astype(np.float32)) > MOST, self._confidence

        def confidence() -> NDArray[np.float32]:
            return np.where(covered, mean(likely()), 0).astype(np.float32)

        rgb = np.asarray(mean(self.rgb), np.uint8)
        return View(rgb, depth_mm, unseen, self.unseen_share, self.warnings, confidence)


class SceneRenderer:
    """A scene ready to be rendered on a device. Serialises its threads: the kernels share buffers.

    scene: all of it but its motion's weights, which its model has.
    """

    def __init__(self, scene: TrainedScene, device: Device = CPU) -> None:
        self.scene = scene.without_motion()
        self._model = model_of(scene, device)
        self._values = blended_values(scene.seen.numpy())
        self._out_of_view = None if self._values is None else OutOfView.of(self.scene, self._model)
        self._lock = RLock()  # who pauses a large render may make a small one

    @cached_property
    def depth_range(self) -> DepthRange:
        """Of the false colours of depth, the same throughout the clip."""
        with self._lock:
            return DepthRange.of(self.scene, self._model)

    def layers(
        self,
        t: float,
        world_from_camera: NDArray[np.float64],
        intrinsics: Intrinsics,
        *,
        highlights: bool = True,
        pause: Callable[[], None] = no_pause,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """R G B Z A [5, H, W], Z unnormalised in units, and blended_values as they are blended [H, W], as copies."""
        camera = view_camera(self.scene, t, world_from_camera, intrinsics, highlights=highlights)
        values = self.values(t)
        with self._lock:
            image = self._model.render(camera, t, values, pause)
        return image[:5], None if values is None else image[5]

    def seen_from(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        """The scene's colour, depth in mm and alpha at model time t."""
        image, _ = self.layers(t, world_from_camera, intrinsics)
        depth_mm = solid_depth_mm(image[3], image[4], self.scene.units_per_mm)
        return RenderedFrame(image[:3].transpose(1, 2, 0), depth_mm, image[4])

    def values(self, t: float) -> NDArray[np.float32] | None:
        """blended_values [N] at model time t: trust where positive. None: not known."""
        if self._values is None or self._out_of_view is None:
            return self._values
        times_s = self.scene.frame_times_s
        time_s = float(np.interp(t * self.scene.frame_count, np.arange(len(times_s)), times_s))
        return self._out_of_view.faded(self._values, time_s)

    def weights(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics, i: int, j: int
    ) -> NDArray[np.float32]:
        """[N] blending weights of the Gaussians at pixel (i, j)."""
        camera = view_camera(self.scene, t, world_from_camera, intrinsics)
        cotangents = np.zeros((5, intrinsics.height, intrinsics.width), np.float32)
        cotangents[0, i, j] = 1  # the gradient of a pixel's red is how much red of each Gaussian it holds
        with self._lock:
            gradient = self._model.image_gradient(camera, t, cotangents)
        return np.asarray(gradient[COLOUR_ROW] / np.float32(SH_C0), np.float32)

    def means_mm(self, t: float) -> NDArray[np.float64]:
        """[N, 3] centres of the Gaussians at model time t, in the world."""
        with self._lock:
            return self._model.deformed_mean(t).T.astype(np.float64) / self.scene.units_per_mm


_renderers: weakref.WeakKeyDictionary[TrainedScene, dict[Device, SceneRenderer]] = weakref.WeakKeyDictionary()
_renderers_lock = Lock()


def renderer_of(scene: TrainedScene, device: Device = CPU) -> SceneRenderer:
    """The scene's renderer on a device, made at its first frame there and kept as long as the scene is."""
    with _renderers_lock:
        made = _renderers.setdefault(scene, {})
        if device not in made:
            made[device] = SceneRenderer(scene, device)
        return made[device]


def render_frame(
    scene: TrainedScene,
    t: float,
    world_from_camera: NDArray[np.float64] | None = None,
    intrinsics: Intrinsics | None = None,
    device: Device = CPU,
    *,
    highlights: bool = True,
    is_coarse: bool = False,
    max_pixels: int = MAX_JUDGED_PIXELS,
    pause: Callable[[], None] = no_pause,
) -> View:
    """The scene at model time t (held within the clip) from a pose (mm; None: the endoscope's) through a camera.

    highlights: as the endoscope's eyes saw them, and away from both their mean; False: without.
    is_coarse: draw and judge no more pixels than asked for, because time is short.
    max_pixels: a picture of fewer is drawn and judged in no more.
    pause: called between the parts of the work (intrasplat/splat/model.py).
    """
    shown, outside = held_in_clip(scene, t)
    own_pose = endoscope_pose(scene, shown)
    pose = own_pose if world_from_camera is None else np.asarray(world_from_camera, np.float64)
    asked = intrinsics or scene.intrinsics
    judged = asked if is_coarse else judged_camera(asked, scene.intrinsics, max_pixels)
    drawn = max(asked, judged, key=_pixels)
    camera = (drawn, pose)
    image, blended = renderer_of(scene, device).layers(shown, pose, camera[0], highlights=highlights, pause=pause)
    size = image.shape[1:]
    rgb, solid = np.empty((*size, 3), np.uint8), np.empty(size, np.bool_)
    # Of a snapshot nothing is known yet: nothing is blended, and 0 is shown.
    depth_mm, trust = np.empty(size, np.float32), np.zeros(size, np.float32)
    for rows in _parts(size):
        part, alpha = image[:, rows], image[4, rows]
        solid[rows] = alpha >= COVERED_ALPHA
        if blended is not None:
            trust[rows] = np.clip(blended[rows] / np.where(solid[rows], alpha, 1), 0, 1) * solid[rows]
        rgb[rows] = np.clip(part[:3].transpose(1, 2, 0) * 255 + 0.5, 0, 255)
        depth_mm[rows] = solid_depth_mm(part[3], alpha, scene.units_per_mm)
        pause()
    is_unseen = partial(unseen_pixels, solid, blended)
    unseen = beside(is_unseen, pause) if solid.size > LARGE_PIXELS else is_unseen()
    pause()
    warnings = (*outside, *scene.pose_warnings, *_warnings_of_pose(_distance_from_trained(scene, pose), trust, unseen))
    if not highlights and scene.right_eye_mm is None:
        warnings = (*warnings, Notice.info(NoticeCode.HIGHLIGHTS_UNKNOWN, HIGHLIGHTS_STAY))
    pause()
    if _pixels(judged) < _pixels(drawn):
        again = partial(
            render_frame, scene, shown, pose, judged, device,
            highlights=highlights, max_pixels=max_pixels, pause=pause,
        )  # fmt: skip
        layer: Callable[[], NDArray[np.float32]] = partial(_enlarged_confidence, again, depth_mm > 0)
    else:
        most = _pixels(asked) if is_coarse else max_pixels
        endoscope = (_compared_camera(drawn, scene.intrinsics, most), own_pose)
        own_view = partial(_endoscope_rgb, scene, shown, endoscope, device, highlights, pause)
        view = (image[:3], depth_mm, trust)
        layer = partial(_confidence, endoscope, camera, view, own_view)
    frame = View(rgb, depth_mm, unseen, _share(unseen), warnings, layer)
    return frame if _pixels(drawn) == _pixels(asked) else frame.reduced(asked.width, asked.height)


def judged_camera(asked: Intrinsics, own: Intrinsics, max_pixels: int = MAX_JUDGED_PIXELS) -> Intrinsics:
    """The view in the pixels in which it is judged: the recording's, as far as they are not too many. A smaller picture
    is drawn in them, too.

    The right eye's lens, and sizes rounded to whole pixels, count as the recording's.
    """
    fine = as_recorded(asked, own)
    if abs(_pixels(fine) / _pixels(asked) - 1) <= AS_FINE:
        return asked
    most = max(min(MAX_JUDGED_PIXELS, max_pixels), _pixels(asked))
    return asked if _pixels(fine) > most == _pixels(asked) else _at_most(fine, most)


def drawn_pixels(
    asked: Intrinsics, own: Intrinsics, max_pixels: int, *, confidence: bool, from_endoscope: bool
) -> list[int]:
    """Pixels of each picture that render_frame draws, of a scene whose lens is `own`.

    confidence: it is asked for, too.
    from_endoscope: the view is from the endoscope's own pose.
    """
    judged = judged_camera(asked, own, max_pixels)
    drawn = [max(asked, judged, key=_pixels)]
    if confidence:
        if _pixels(judged) < _pixels(asked):
            drawn.append(judged)
        compared = _compared_camera(drawn[-1], own, max_pixels)
        if not from_endoscope or compared != drawn[-1]:
            drawn.append(compared)
    return [_pixels(each) for each in drawn]


def _compared_camera(judged: Intrinsics, own: Intrinsics, max_pixels: int) -> Intrinsics:
    """The endoscope's lens, in pixels as fine as those of a view that is compared with it, and no more than allowed."""
    across, down = min(judged.fx / own.fx, 1.0), min(judged.fy / own.fy, 1.0)
    as_fine = own
    if across * down < 1 - AS_FINE:
        as_fine = own.resized(max(1, round(own.width * across)), max(1, round(own.height * down)))
    return _at_most(as_fine, max(max_pixels, _pixels(judged)))


def _at_most(camera: Intrinsics, most: int) -> Intrinsics:
    """The same view in at most so many pixels."""
    if _pixels(camera) <= most:
        return camera
    share = math.sqrt(most / _pixels(camera))
    width = min(max(1, int(camera.width * share)), MAX_JUDGED_SIDE, most)
    return camera.resized(width, min(max(1, int(camera.height * share)), MAX_JUDGED_SIDE, most // width))


def _pixels(camera: Intrinsics) -> int:
    return camera.width * camera.height


def _enlarged_confidence(judged: Callable[[], View], solid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[H, W] the confidence of the frame between its pixels, 0 where nothing solid [H, W] is drawn."""
    likely = cv2.resize(judged().confidence, solid.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(solid, likely, 0).astype(np.float32)


def held_in_clip(scene: TrainedScene, t: float) -> tuple[float, tuple[Notice, ...]]:
    """The model time that is shown for t, and the warning that says so if it is another."""
    last = (scene.frame_count - 1) / scene.frame_count
    shown = min(max(t, 0.0), last)
    if 0.0 <= t <= last + ROUNDING:
        return shown, ()
    text = f"t = {t:g} lies outside the clip; t = {shown:.4g} is shown."
    return shown, (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, text),)


def _parts(size: tuple[int, ...]) -> Iterator[slice]:
    """Rows of an image of H x W, PART_PIXELS of them at a time."""
    height, width = size
    step = max(1, PART_PIXELS // width)
    return (slice(first, min(first + step, height)) for first in range(0, height, step))


def _endoscope_rgb(
    scene: TrainedScene,
    t: float,
    endoscope: tuple[Intrinsics, NDArray[np.float64]],
    device: Device,
    highlights: bool,
    pause: Callable[[], None],
) -> NDArray[np.float32]:
    """[3, h, w] of the endoscope's own view at t."""
    lens, pose = endoscope
    image, _ = renderer_of(scene, device).layers(t, pose, lens, highlights=highlights, pause=pause)
    return image[:3]


def _confidence(
    endoscope: tuple[Intrinsics, NDArray[np.float64]],
    camera: tuple[Intrinsics, NDArray[np.float64]],
    view: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    own_view: Callable[[], NDArray[np.float32]],
) -> NDArray[np.float32]:
    """The confidence layer [H, W] of a view, given as colours [3, H, W], depth in mm and trust; 0 where trust is."""
    rgb, depth_mm, trust = view
    known_rgb = rgb
    if not np.array_equal(camera[1], endoscope[1]) or camera[0] != endoscope[0]:
        known_rgb = seen_from_endoscope(own_view(), depth_mm, camera, endoscope)
    likely = confidence(evidence(trust, rgb, known_rgb))
    return np.where(trust > 0, likely, 0).astype(np.float32)


def _warnings_of_pose(distance: float, trust: NDArray[np.float32], unseen: NDArray[np.bool_]) -> Iterator[Notice]:
    if distance > FAR_POSE:
        text = f"This pose is {distance:.1f} viewing distances from the endoscope's: most of it is a guess."
        yield Notice.warning(NoticeCode.POSE_FAR, text)
    if (share := _share(unseen)) > MAX_UNSEEN_SHARE:
        text = f"No frame saw {share:.0%} of this view. unseen=mark hatches it, unseen=guess shows a guess."
        yield Notice.warning(NoticeCode.UNSEEN, text)
    if _share((trust < LOW_TRUST) & ~unseen) > MAX_LOW_SHARE:
        yield Notice.warning(NoticeCode.HARDLY_SEEN, HARDLY_SEEN)


def _share(pixels: NDArray[np.bool_]) -> float:
    """Of the pixels that are true. mean() would take ten times as long, and no pause can interrupt it."""
    return float(np.count_nonzero(pixels) / pixels.size)


def _distance_from_trained(scene: TrainedScene, pose: NDArray[np.float64]) -> float:
    """Distance of the camera's centre from the nearest trained one, in median depths of the clip."""
    centres = scene.world_from_camera[scene.trained_frames][:, :3, 3]
    nearest_mm = float(np.linalg.norm(centres - pose[:3, 3], axis=1).min())
    return nearest_mm * scene.units_per_mm / MEDIAN_DEPTH_UNITS
