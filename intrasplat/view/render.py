"""Render a stored scene at any time, from any pose, through any pinhole camera: colour, depth and confidence.

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import SceneError
from intrasplat.machine.parts import Parts, whole
from intrasplat.names import Detail as DetailSwitch
from intrasplat.names import Light, Smoke
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import MAX_JUDGED_PIXELS
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.cpu.threads import run
from intrasplat.splat.metrics import COVERED_ALPHA
from intrasplat.splat.model import ProjectedPicture
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.aside import aside
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.confidence import confidence, evidence, followed, seen_from_endoscope
from intrasplat.view.detail import Added
from intrasplat.view.frame import View
from intrasplat.view.lenses import Lenses, pixel_count
from intrasplat.view.recorded_light import EndoscopeLight
from intrasplat.view.renderer import renderer_of
from intrasplat.view.smoky import smoke_share, with_smoke
from intrasplat.view.transfer import in_levels
from intrasplat.view.unseen import missing_pixels, unseen_pixels

FAR_DEG = 20.0
"""A frame warns when the median ray meets the surface at more than this angle to every recording eye's: it shows sides
that the clip never saw."""
MAX_ENLARGEMENT = 4.0
"""A frame warns when it is nearer to the surface than the clip by more than this factor."""
MOST_DEG, MOST_ENLARGED = 60.0, 100.0
"""Beyond these, warnings name no figure: rays run along the plane that stands for the surface."""
LOW_TRUST, MAX_LOW_SHARE = 0.1, 0.1
"""A frame warns when more than MAX_LOW_SHARE of its pixels show Gaussians of less trust than LOW_TRUST."""
HARDLY_SEEN = "More than a tenth of this view was hardly seen in the clip; see layer=confidence."
MIN_FOLLOWED = 0.75
"""A frame warns if its confidence is multiplied by less than this, because the motion was not followed."""
GUESSED = "This moment lies between training frames that are too far apart to follow the tissue: its place is a guess."
MAX_UNSEEN_SHARE = 0.05
"""A frame warns when more than this share of its pixels is unseen."""
HIGHLIGHTS_STAY = "This scene was taught by one eye, so its highlights are not known apart: they stay."
ROUNDING = 1e-6
"""Model time by which t may exceed the last frame's without a warning: a caller may have rounded i / T."""


@dataclass(frozen=True, eq=False)
class ViewRequest:
    """What a frame shows, and how it is rendered.

    t                  model time, clamped to the clip
    world_from_camera  [4, 4] mm; None: the endoscope's own at t
    intrinsics         None: the recording's
    device             device that renders
    highlights         True: as the endoscope's eyes saw them, and their mean away from both; False: without highlights
    light              "steady": that of one frame, at all times; "recorded": that of the time
    smoke              whether to draw the smoke of the recording
    detail             whether to add what the model misses of the recorded frames, if those are kept; not if is_coarse
    is_coarse          draw and judge no more pixels than asked for, because time is short
    max_pixels         limit of the pixels in which a smaller picture is drawn and judged
    """

    scene: TrainedScene
    t: float
    world_from_camera: NDArray[np.float64] | None = None
    intrinsics: Intrinsics | None = None
    device: Device = CPU
    highlights: bool = True
    light: Light = "steady"
    smoke: Smoke = "remove"
    detail: DetailSwitch = "on"
    is_coarse: bool = False
    max_pixels: int = MAX_JUDGED_PIXELS

    @cached_property
    def shown_t(self) -> float:
        """The model time, clamped to the clip."""
        return clamped_to_clip(self.scene, self.t)[0]

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

    def projected(self, pose: NDArray[np.float64], lens: Intrinsics) -> AbstractContextManager[ProjectedPicture]:
        """The scene at that time, projected from a pose through a lens (SceneRenderer.projected)."""
        renderer = renderer_of(self.scene, self.device)
        return renderer.projected(self.shown_t, pose, lens, highlights=self.highlights)


def render_frame(
    scene: TrainedScene,
    t: float,
    world_from_camera: NDArray[np.float64] | None = None,
    intrinsics: Intrinsics | None = None,
    device: Device = CPU,
    *,
    highlights: bool = True,
    light: Light = "steady",
    smoke: Smoke = "remove",
    detail: DetailSwitch = "on",
) -> View:
    """Render the scene at model time t from a pose through a camera. The arguments are those of ViewRequest."""
    view = ViewRequest(scene, t, world_from_camera, intrinsics, device, highlights, light, smoke, detail)
    return whole(frame_in_parts(view))


def frame_in_parts(view: ViewRequest, *, with_confidence: bool = False) -> Parts[View]:
    """Render the frame of a view in parts of 10 to 30 ms on one core.

    with_confidence: compute confidence now, in parts, and not at the first access.
    """
    lenses, scene = view.lenses, view.scene
    renderer_of(scene, view.device)  # takes long for the first frame of a scene
    yield
    has_detail = view.detail == "on" and not view.is_coarse and scene.pictures is not None
    with_colours = has_detail or lenses.judged == lenses.drawn
    picture = yield from _rendered(view, lenses.drawn, with_colours=with_colours, with_rgb=not has_detail)
    added, of_detail = (yield from _add_detail(view, picture)) if has_detail else (None, ())
    unseen = unseen_pixels(picture.missing)
    rgb, drawn = picture.rgb, (lenses.drawn, view.pose)
    if view.smoke == "show":
        colours = np.asarray(rgb / np.float32(255), np.float32)
        coloured = with_smoke(scene, view.shown_t, colours, picture.depth_mm, drawn)
        rgb = np.asarray(np.clip(coloured * 255 + np.float32(0.5), 0, 255), np.uint8)
    yield
    outside = clamped_to_clip(scene, view.t)[1]
    if followed(scene, view.shown_t) < MIN_FOLLOWED:
        outside = (*outside, Notice.warning(NoticeCode.MOTION_GUESSED, GUESSED))
    warnings = (*outside, *of_detail, *scene.pose_warnings, *_warnings_of_pose(view, picture.trust, unseen))
    if not view.highlights and scene.right_eye_mm is None:
        warnings = (*warnings, Notice.info(NoticeCode.HIGHLIGHTS_UNKNOWN, HIGHLIGHTS_STAY))
    yield
    weight = None if added is None or scene.right_eye_mm is None else added.weight
    known = (yield from _confidence(view, picture, weight)) if with_confidence else None

    def likely() -> NDArray[np.float32]:
        return whole(_confidence(view, picture, weight)) if known is None else known

    def smoke() -> NDArray[np.float32]:
        return smoke_share(scene, view.shown_t, picture.depth_mm, drawn)

    detail_share = 0.0 if added is None else added.share(picture.depth_mm)
    frame = View(rgb, picture.depth_mm, unseen, _share(unseen), detail_share, warnings, likely, smoke)
    is_as_asked = pixel_count(lenses.drawn) == pixel_count(lenses.asked)
    return frame if is_as_asked else frame.reduced(lenses.asked.width, lenses.asked.height)


@dataclass(frozen=True, eq=False)
class _Picture:
    """A rendered view before it is judged.

    rgb       [H, W, 3] uint8
    depth_mm  [H, W] float32, camera z; 0 where nothing is solid
    missing   [H, W] bool (missing_pixels)
    trust     [H, W] float32 in [0, 1]; 0 everywhere if it is not known, as for a snapshot
    colours   [3, H, W] float32, unclipped, of the model alone; None: not needed
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    missing: NDArray[np.bool_]
    trust: NDArray[np.float32]
    colours: NDArray[np.float32] | None

    @classmethod
    def empty(cls, height: int, width: int, *, with_colours: bool) -> _Picture:
        """A picture whose rows fill() sets."""
        size = (height, width)
        rgb, depth_mm, missing = np.empty((*size, 3), np.uint8), np.empty(size, np.float32), np.empty(size, np.bool_)
        colours = np.empty((3, *size), np.float32) if with_colours else None
        return cls(rgb, depth_mm, missing, np.zeros(size, np.float32), colours)

    def fill(
        self,
        rows: slice,
        band: NDArray[np.float32],
        units_per_mm: float,
        light: EndoscopeLight | None,
        *,
        with_rgb: bool,
    ) -> None:
        """Set these rows from the blended planes R G B Z A and, if known, blended_values: [5 or 6, h, W].

        light: that rgb is shown in; None: the model's. with_rgb: whether to set rgb.
        """
        alpha, blended = band[4], band[5] if len(band) > 5 else None
        solid = alpha >= COVERED_ALPHA
        self.missing[rows] = missing_pixels(solid, blended)
        if blended is not None:
            self.trust[rows] = np.clip(blended / np.where(solid, alpha, 1), 0, 1) * solid
        if self.colours is not None:
            self.colours[:, rows] = band[:3]
        self.depth_mm[rows] = solid_depth_mm(band[3], alpha, units_per_mm)
        if not with_rgb:
            return
        factors = None if light is None else light.factors(self.depth_mm[rows], rows)
        levels = np.float32(255) if factors is None else 255 * factors
        self.rgb[rows] = np.clip(band[:3].transpose(1, 2, 0) * levels + 0.5, 0, 255)


def _rendered(view: ViewRequest, lens: Intrinsics, *, with_colours: bool, with_rgb: bool = True) -> Parts[_Picture]:
    """The view's picture through a lens: two parts for the projection and one for each band."""
    with view.projected(view.pose, lens) as projected:
        yield
        projected.sort()
        yield
        picture = _Picture.empty(lens.height, lens.width, with_colours=with_colours)
        recorded = EndoscopeLight(view.scene, view.shown_t, view.pose, lens) if view.light == "recorded" else None
        for rows in projected.bands:
            picture.fill(rows, projected.blend(rows), view.scene.units_per_mm, recorded, with_rgb=with_rgb)
            yield
    return picture


def _add_detail(view: ViewRequest, picture: _Picture) -> Parts[tuple[Added | None, tuple[Notice, ...]]]:
    """Set the picture's rgb: its colours and what they miss of the recorded frames.

    Returns what was added, None if there are no such frames, and a warning if they cannot be read.
    """
    assert picture.colours is not None
    renderer, lens = renderer_of(view.scene, view.device), view.lenses.drawn
    added, warnings = None, tuple[Notice, ...]()
    try:
        if (detail := renderer.detail) is not None:
            added = yield from detail.added(
                renderer, view.shown_t, view.pose, lens, picture.depth_mm, highlights=view.highlights
            )
    except SceneError as error:
        warnings = (Notice.warning(NoticeCode.DETAIL_MISSING, f"The model is shown alone: {error}"),)
    yield
    factors = None
    if view.light == "recorded":
        factors = EndoscopeLight(view.scene, view.shown_t, view.pose, lens).factors(picture.depth_mm)
    light = np.broadcast_to(np.float32(1) if factors is None else factors, picture.rgb.shape)
    missed = (added or Added.nothing(picture.depth_mm.shape)).rgb
    run(in_levels, picture.colours, missed, light, picture.rgb)
    return added, warnings


def _confidence(view: ViewRequest, picture: _Picture, detail: NDArray[np.float32] | None) -> Parts[NDArray[np.float32]]:
    """[H, W] the confidence of a view's picture; 0 where nothing solid is drawn or trust is 0.

    detail: as in confidence(), of the picture's size.

    If the picture has more pixels than it is judged in, it is rendered again in those, and its confidence is enlarged.
    """
    lenses, judged = view.lenses, picture
    if lenses.judged != lenses.drawn:
        judged = yield from _rendered(view, lenses.judged, with_colours=True)
    assert judged.colours is not None
    known_rgb = judged.colours
    if lenses.judged != lenses.endoscope or not np.array_equal(view.pose, view.endoscope_pose):
        own_rgb = yield from _endoscope_rgb(view)
        camera, endoscope = (lenses.judged, view.pose), (lenses.endoscope, view.endoscope_pose)
        known_rgb = seen_from_endoscope(own_rgb, judged.depth_mm, camera, endoscope)
        yield
    if detail is not None and judged is not picture:
        detail = cv2.resize(detail, judged.missing.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    likely = confidence(evidence(judged.trust, judged.colours, known_rgb), detail)
    likely *= np.float32(followed(view.scene, view.shown_t))
    likely = np.where(judged.trust > 0, likely, 0).astype(np.float32)
    if judged is picture:
        return likely
    yield
    enlarged = cv2.resize(likely, picture.missing.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(picture.depth_mm > 0, enlarged, 0).astype(np.float32)


def _endoscope_rgb(view: ViewRequest) -> Parts[NDArray[np.float32]]:
    """[3, h, w] colours of the endoscope's own view at the view's time."""
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


def clamped_to_clip(scene: TrainedScene, t: float) -> tuple[float, tuple[Notice, ...]]:
    """t clamped to the clip, and a warning if that changes it."""
    last = (scene.frame_count - 1) / scene.frame_count
    shown = min(max(t, 0.0), last)
    if 0.0 <= t <= last + ROUNDING:
        return shown, ()
    text = f"t = {t:g} lies outside the clip; t = {shown:.4g} is shown."
    return shown, (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, text),)


def _warnings_of_pose(view: ViewRequest, trust: NDArray[np.float32], unseen: NDArray[np.bool_]) -> Iterator[Notice]:
    angle_deg, enlargement = aside(view.scene, view.pose, view.lenses.drawn)
    if angle_deg > FAR_DEG:
        said = f"{angle_deg:.0f}" if angle_deg <= MOST_DEG else f"more than {MOST_DEG:.0f}"
        text = f"This view looks from {said} degrees beside the endoscope: most of it is a guess."
        yield Notice.warning(NoticeCode.POSE_FAR, text)
    if enlargement > MAX_ENLARGEMENT:
        said = f"{enlargement:.1f}" if enlargement <= MOST_ENLARGED else f"more than {MOST_ENLARGED:.0f}"
        text = f"This view is enlarged {said} times: it holds no finer detail than the clip."
        yield Notice.warning(NoticeCode.ENLARGED, text)
    if (share := _share(unseen)) > MAX_UNSEEN_SHARE:
        text = f"No frame saw {share:.0%} of this view. unseen=mark hatches it, unseen=guess shows a guess."
        yield Notice.warning(NoticeCode.UNSEEN, text)
    if _share((trust < LOW_TRUST) & ~unseen) > MAX_LOW_SHARE:
        yield Notice.warning(NoticeCode.HARDLY_SEEN, HARDLY_SEEN)


def _share(pixels: NDArray[np.bool_]) -> float:
    """The share of pixels that are true. mean() would take ten times as long."""
    return float(np.count_nonzero(pixels) / pixels.size)
