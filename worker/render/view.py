"""Frames of a stored scene: any time, any pose, any pinhole camera; colour, depth and how far to trust each pixel.

N Gaussians, H W pixels. Scenes keep their kernels' buffers between frames, so the second frame of a size is fast.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.notices import Notice, NoticeCode
from contract.wire.rendering import MAX_JUDGED_PIXELS
from worker.input.camera import Intrinsics
from worker.machine.parts import Parts, whole
from worker.model.constants import SH_C0
from worker.model.layout import COLOUR_ROW
from worker.model.metrics import COVERED_ALPHA
from worker.raster.backend import CPU, Device
from worker.raster.model import Projected
from worker.render.camera import endoscope_pose, view_camera
from worker.render.confidence import confidence, evidence, seen_from_endoscope
from worker.render.depth_range import DepthRange
from worker.render.frame import Frame
from worker.render.left import OutOfView
from worker.render.lenses import Lenses, pixel_count
from worker.render.unseen import blended_values, missing_pixels, unseen_pixels
from worker.scene.model import model_of
from worker.scene.scene import Scene
from worker.train.hooks import RenderedFrame
from worker.train.targets import MEDIAN_DEPTH_UNITS, solid_depth_mm

FAR_POSE = 0.35
"""Distance from the nearest trained pose, in median depths, beyond which the frame carries a warning, because it shows
sides that the clip never saw."""
LOW_TRUST, MAX_LOW_SHARE = 0.1, 0.1
"""A frame warns when more than this share of its pixels show Gaussians that are trusted less, as seen by the clip."""
HARDLY_SEEN = "More than a tenth of this view was hardly seen in the clip; see layer=confidence."
MAX_UNSEEN_SHARE = 0.05
"""A frame warns when more than this share of its pixels is unseen."""
HIGHLIGHTS_STAY = "This scene was taught by one eye, so its highlights are not known apart: they stay."
ROUNDING = 1e-6
"""Model time by which t may exceed the last frame's without a warning: a decimal fraction may round i / T."""


class SceneRenderer:
    """A scene ready to be rendered on a device. Serialises its threads: the kernels share buffers.

    scene: all of it but its motion's weights, which its model has.
    """

    def __init__(self, scene: Scene, device: Device = CPU) -> None:
        self.scene = scene.without_motion()
        self._model = model_of(scene, device)
        self._values = blended_values(scene.seen.numpy())
        self._out_of_view = None if self._values is None else OutOfView.of(self.scene, self._model)
        self._lock = Lock()

    @cached_property
    def depth_range(self) -> DepthRange:
        """Of the false colours of depth, the same throughout the clip."""
        with self._lock:
            return DepthRange.of(self.scene, self._model)

    def layers(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """R G B Z A [5, H, W], Z unnormalised in units, and blended_values as they are blended [H, W], as copies."""
        camera = view_camera(self.scene, t, world_from_camera, intrinsics)
        values = self.values(t)
        with self._lock:
            image = self._model.render(camera, t, values).copy()
        return image[:5], None if values is None else image[5]

    @contextmanager
    def projected(
        self,
        t: float,
        world_from_camera: NDArray[np.float64],
        intrinsics: Intrinsics,
        *,
        highlights: bool = True,
    ) -> Iterator[Projected]:
        """R G B Z A, and as sixth plane blended_values if they are known, to be sorted and blended in bands.

        Other pictures of the scene may be rendered meanwhile.
        """
        camera = view_camera(self.scene, t, world_from_camera, intrinsics, highlights=highlights)
        values = self.values(t)
        with self._lock:
            picture = self._model.projected(camera, t, values)
        try:
            yield picture
        finally:
            with self._lock:
                picture.close()

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


_renderers: weakref.WeakKeyDictionary[Scene, dict[Device, SceneRenderer]] = weakref.WeakKeyDictionary()
_renderers_lock = Lock()


def renderer_of(scene: Scene, device: Device = CPU) -> SceneRenderer:
    """The scene's renderer on a device, made at its first frame there and kept as long as the scene is."""
    with _renderers_lock:
        made = _renderers.setdefault(scene, {})
        if device not in made:
            made[device] = SceneRenderer(scene, device)
        return made[device]


@dataclass(frozen=True, eq=False)
class View:
    """What a frame shows, and how it is made.

    t                  model time, held within the clip
    world_from_camera  [4, 4] mm; None: the endoscope's own at t
    intrinsics         None: the recording's
    device             that renders
    highlights         True: as the endoscope's eyes saw them, and away from both their mean; False: without
    is_coarse          draw and judge no more pixels than asked for, because time is short
    max_pixels         a picture of fewer is drawn and judged in no more
    """

    scene: Scene
    t: float
    world_from_camera: NDArray[np.float64] | None = None
    intrinsics: Intrinsics | None = None
    device: Device = CPU
    highlights: bool = True
    is_coarse: bool = False
    max_pixels: int = MAX_JUDGED_PIXELS

    @cached_property
    def shown_t(self) -> float:
        """The model time within the clip."""
        return held_in_clip(self.scene, self.t)[0]

    @cached_property
    def endoscope_pose(self) -> NDArray[np.float64]:
        """world_from_camera [4, 4] mm of the endoscope at that time."""
        return endoscope_pose(self.scene, self.shown_t)

    @cached_property
    def pose(self) -> NDArray[np.float64]:
        """world_from_camera [4, 4] mm of the frame."""
        given = self.world_from_camera
        return self.endoscope_pose if given is None else np.asarray(given, np.float64)

    @cached_property
    def lenses(self) -> Lenses:
        """The cameras behind the frame."""
        own = self.scene.intrinsics
        return Lenses.of(self.intrinsics or own, own, self.max_pixels, is_coarse=self.is_coarse)

    def projected(self, pose: NDArray[np.float64], lens: Intrinsics) -> AbstractContextManager[Projected]:
        """The scene at that time, from a pose through a lens, to be blended (SceneRenderer.projected)."""
        renderer = renderer_of(self.scene, self.device)
        return renderer.projected(self.shown_t, pose, lens, highlights=self.highlights)


def render_frame(
    scene: Scene,
    t: float,
    world_from_camera: NDArray[np.float64] | None = None,
    intrinsics: Intrinsics | None = None,
    device: Device = CPU,
    *,
    highlights: bool = True,
) -> Frame:
    """The scene at model time t from a pose through a camera. The arguments are those of a View."""
    return whole(frame_in_parts(View(scene, t, world_from_camera, intrinsics, device, highlights)))


def frame_in_parts(view: View, *, with_confidence: bool = False) -> Parts[Frame]:
    """The frame of a view, in parts of 10 to 30 ms on one core.

    with_confidence: compute it now, in parts, and not when somebody asks for it.
    """
    lenses, scene = view.lenses, view.scene
    renderer_of(scene, view.device)  # the first of a scene takes long
    yield
    picture = yield from _rendered(view, lenses.drawn, with_colours=lenses.judged == lenses.drawn)
    unseen = unseen_pixels(picture.missing)
    yield
    outside = held_in_clip(scene, view.t)[1]
    warnings = (*outside, *scene.pose_warnings, *_warnings_of_pose(view, picture.trust, unseen))
    if not view.highlights and scene.right_eye_mm is None:
        warnings = (*warnings, Notice.info(NoticeCode.HIGHLIGHTS_UNKNOWN, HIGHLIGHTS_STAY))
    yield
    known = (yield from _confidence(view, picture)) if with_confidence else None

    def likely() -> NDArray[np.float32]:
        return whole(_confidence(view, picture)) if known is None else known

    frame = Frame(picture.rgb, picture.depth_mm, unseen, _share(unseen), warnings, likely)
    is_as_asked = pixel_count(lenses.drawn) == pixel_count(lenses.asked)
    return frame if is_as_asked else frame.reduced(lenses.asked.width, lenses.asked.height)


@dataclass(frozen=True, eq=False)
class _Picture:
    """A rendered view before it is judged.

    rgb       [H, W, 3] uint8
    depth_mm  [H, W] float32, camera z, 0 where nothing solid is
    missing   [H, W] bool (missing_pixels)
    trust     [H, W] float32 in [0, 1]; 0 everywhere if it is not known, as of a snapshot
    colours   [3, H, W] float32, unclipped; None: not needed
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    missing: NDArray[np.bool_]
    trust: NDArray[np.float32]
    colours: NDArray[np.float32] | None

    @classmethod
    def empty(cls, height: int, width: int, *, with_colours: bool) -> _Picture:
        """One to be filled."""
        size = (height, width)
        rgb, depth_mm, missing = np.empty((*size, 3), np.uint8), np.empty(size, np.float32), np.empty(size, np.bool_)
        colours = np.empty((3, *size), np.float32) if with_colours else None
        return cls(rgb, depth_mm, missing, np.zeros(size, np.float32), colours)

    def fill(self, rows: slice, band: NDArray[np.float32], units_per_mm: float) -> None:
        """These rows, from R G B Z A and, if they are known, blended_values as they are blended: [5 or 6, h, W]."""
        alpha, blended = band[4], band[5] if len(band) > 5 else None
        solid = alpha >= COVERED_ALPHA
        self.missing[rows] = missing_pixels(solid, blended)
        if blended is not None:
            self.trust[rows] = np.clip(blended / np.where(solid, alpha, 1), 0, 1) * solid
        if self.colours is not None:
            self.colours[:, rows] = band[:3]
        self.rgb[rows] = np.clip(band[:3].transpose(1, 2, 0) * 255 + 0.5, 0, 255)
        self.depth_mm[rows] = solid_depth_mm(band[3], alpha, units_per_mm)


def _rendered(view: View, lens: Intrinsics, *, with_colours: bool) -> Parts[_Picture]:
    """The view's picture through a lens: two parts for the projection and one for each band."""
    with view.projected(view.pose, lens) as projected:
        yield
        projected.sort()
        yield
        picture = _Picture.empty(lens.height, lens.width, with_colours=with_colours)
        for rows in projected.bands:
            picture.fill(rows, projected.blend(rows), view.scene.units_per_mm)
            yield
    return picture


def _confidence(view: View, picture: _Picture) -> Parts[NDArray[np.float32]]:
    """[H, W] the confidence of a view's picture; 0 where nothing solid is drawn or trust is 0.

    A picture of more pixels than it is judged in is rendered again in those, and its confidence enlarged.
    """
    lenses, judged = view.lenses, picture
    if picture.colours is None:
        judged = yield from _rendered(view, lenses.judged, with_colours=True)
    assert judged.colours is not None
    known_rgb = judged.colours
    if lenses.judged != lenses.endoscope or not np.array_equal(view.pose, view.endoscope_pose):
        own_rgb = yield from _endoscope_rgb(view)
        camera, endoscope = (lenses.judged, view.pose), (lenses.endoscope, view.endoscope_pose)
        known_rgb = seen_from_endoscope(own_rgb, judged.depth_mm, camera, endoscope)
        yield
    likely = confidence(evidence(judged.trust, judged.colours, known_rgb))
    likely = np.where(judged.trust > 0, likely, 0).astype(np.float32)
    if judged is picture:
        return likely
    yield
    enlarged = cv2.resize(likely, picture.missing.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(picture.depth_mm > 0, enlarged, 0).astype(np.float32)


def _endoscope_rgb(view: View) -> Parts[NDArray[np.float32]]:
    """[3, h, w] of the endoscope's own view at the view's time."""
    lens = view.lenses.endoscope
    colours = np.empty((3, lens.height, lens.width), np.float32)
    with view.projected(view.endoscope_pose, lens) as projected:
        yield
        projected.sort()
        yield
        for rows in projected.bands:
            colours[:, rows] = projected.blend(rows)[:3]
            yield
    return colours


def held_in_clip(scene: Scene, t: float) -> tuple[float, tuple[Notice, ...]]:
    """The model time that is shown for t, and the warning that says so if it is another."""
    last = (scene.frame_count - 1) / scene.frame_count
    shown = min(max(t, 0.0), last)
    if 0.0 <= t <= last + ROUNDING:
        return shown, ()
    text = f"t = {t:g} lies outside the clip; t = {shown:.4g} is shown."
    return shown, (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, text),)


def _warnings_of_pose(view: View, trust: NDArray[np.float32], unseen: NDArray[np.bool_]) -> Iterator[Notice]:
    if (distance := _distance_from_trained(view.scene, view.pose)) > FAR_POSE:
        text = f"This pose is {distance:.1f} viewing distances from the endoscope's: most of it is a guess."
        yield Notice.warning(NoticeCode.POSE_FAR, text)
    if (share := _share(unseen)) > MAX_UNSEEN_SHARE:
        text = f"No frame saw {share:.0%} of this view. unseen=mark hatches it, unseen=guess shows a guess."
        yield Notice.warning(NoticeCode.UNSEEN, text)
    if _share((trust < LOW_TRUST) & ~unseen) > MAX_LOW_SHARE:
        yield Notice.warning(NoticeCode.HARDLY_SEEN, HARDLY_SEEN)


def _share(pixels: NDArray[np.bool_]) -> float:
    """Of the pixels that are true. mean() would take ten times as long."""
    return float(np.count_nonzero(pixels) / pixels.size)


def _distance_from_trained(scene: Scene, pose: NDArray[np.float64]) -> float:
    """Distance of the camera's centre from the nearest trained one, in median depths of the clip."""
    centres = scene.world_from_camera[scene.trained_frames][:, :3, 3]
    nearest_mm = float(np.linalg.norm(centres - pose[:3, 3], axis=1).min())
    return nearest_mm * scene.units_per_mm / MEDIAN_DEPTH_UNITS
