"""Render, measure and export any scene: what finished scenes, jobs in training and live feeds share."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from contract.runtime import traces
from contract.wire.rendering import (
    TYPICAL_GAUSSIANS,
    TYPICAL_SIZE,
    ExportRequest,
    MeasureRequest,
    PictureCamera,
    RenderRequest,
    render_cost,
)
from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError, SceneError
from intrasplat.export import DRAWN, export_parts
from intrasplat.formats import EXPORT_FORMATS
from intrasplat.machine.parts import Parts
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import MEDIA_TYPES, Layer
from intrasplat.report import RightEye
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import Device
from intrasplat.splat.cpu.threads import beside
from intrasplat.view.camera import camera_of, endoscope_pose, pose_of, right_eye, seen_through
from intrasplat.view.coarse import LEVELS, thinned
from intrasplat.view.encode import FOR_EYES, encode_layer
from intrasplat.view.error import AS_RECORDED, check_comparable, error_levels
from intrasplat.view.frame import View
from intrasplat.view.lenses import Lenses
from intrasplat.view.measure import WINDOW_PX
from intrasplat.view.measured import measured
from intrasplat.view.recorded import RecordedPicture
from intrasplat.view.render import ROUNDING, ViewRequest, clamped_to_clip, frame_in_parts
from intrasplat.view.renderer import renderer_of
from worker.exports import OpenExports
from worker.reply import Reply

MEDIA_TYPE_OF_BYTES, MEDIA_TYPE_OF_JSON = "application/octet-stream", "application/json"

LARGE_PIXELS = 1 << 19
"""Pictures of more pixels take so long to encode that other answers are computed meanwhile."""


def rendered(
    scene: TrainedScene,
    request: RenderRequest,
    level: int,
    device: Device,
    right_eye_of_scene: Callable[[], RightEye | None],
    recorded_of_scene: Callable[[], RecordedPicture],
) -> Parts[Reply]:
    """One render of a scene at request.t. level: of detail. right_eye_of_scene is asked only if that eye is, and
    recorded_of_scene, the recorded frame nearest to request.t, only for layer error: the view is then that of its time.

    Raises:
        InputError, LimitError: as Views.answer_in_parts.
    """
    recorded = None
    if request.layer is Layer.ERROR:
        check_comparable(request.pose, request.camera)
        try:
            recorded, level = recorded_of_scene(), 0
        except SceneError as missing:  # the scene itself is there
            raise InputError("layer", str(missing), "Ask for another layer.") from missing
        request = request.model_copy(update={**AS_RECORDED, "t": recorded.index / scene.frame_count})
    pose, lens = _pose_and_lens(scene, request, right_eye_of_scene)
    camera = camera_of(lens, request.camera, request.max_pixels)
    size, highlights = (camera.width, camera.height), request.highlights.shown_in(request.layer)
    own = endoscope_pose(scene, clamped_to_clip(scene, request.t)[0]) if pose is None else pose
    pose_rows = tuple(own[:3].flatten().tolist())
    picture_camera = PictureCamera.model_validate({**camera.numbers(), "world_from_camera": pose_rows})
    coarse = LEVELS[level]
    camera = camera.resized(-(-camera.width // coarse.pixels), -(-camera.height // coarse.pixels))
    drawn = thinned(scene, coarse.gaussians)
    attributes = traces.Attributes(width=size[0], height=size[1], level=level, gaussians=len(drawn.gaussians))
    view = ViewRequest(
        drawn, request.t, pose, camera, device,
        highlights=highlights, light=request.light, smoke=request.smoke,
        detail=request.detail if request.layer is Layer.RGB else "off",
        is_coarse=level > 0, max_pixels=request.max_pixels,
    )  # fmt: skip
    with traces.span("draw", **attributes):
        frame = yield from frame_in_parts(view, with_confidence=request.layer is Layer.CONFIDENCE)
    range_mm = None
    if request.layer is Layer.DEPTH and request.format in FOR_EYES:
        range_mm = renderer_of(drawn, device).depth_range.chosen(pose, request.near_mm, request.far_mm)
    frame = frame.enlarged(*size) if level else frame
    error = None if recorded is None else error_levels(frame.rgb, recorded, frame.unseen)
    body = yield from _encoded(frame, request, range_mm, error)
    return Reply(
        body,
        MEDIA_TYPES[request.format],
        clamped_to_clip(scene, request.t)[0],
        frame.warnings,
        unseen=frame.unseen_share,
        detail=frame.detail_share,
        gaussians=len(scene.gaussians),
        clip_size=(scene.intrinsics.width, scene.intrinsics.height),
        level=level,
        depth_range_mm=range_mm,
        camera=picture_camera,
    )


def measured_reply(scene: TrainedScene, request: MeasureRequest, device: Device) -> Reply:
    """A Measurement as JSON. Its time does not predict that of renders."""
    camera = camera_of(scene.intrinsics, request.camera, request.max_pixels)
    pose = pose_of(scene, request.pose)
    found = measured(scene, request.t, pose, camera, request.points, device, shape=request.shape)
    return Reply(found.model_dump_json().encode(), MEDIA_TYPE_OF_JSON, found.t, found.warnings, is_untimed=True)


def export_reply(exports: OpenExports, scene: TrainedScene, request: ExportRequest, device: Device) -> Reply:
    """One part of an export. Its time does not predict that of renders."""
    content, more = exports.part(request, lambda: export_parts(scene, request.format, request.options, device))
    known, t = EXPORT_FORMATS.get(request.format), request.options.t or 0.0
    shown, warnings = clamped_to_clip(scene, t)[0], scene.pose_warnings
    if t > shown + ROUNDING:
        outside = f"t = {t:g} lies outside the clip; t = {shown:.4g} is exported."
        warnings = (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, outside), *warnings)
    media_type = MEDIA_TYPE_OF_BYTES if known is None else known.media_type
    return Reply(content, media_type, shown, warnings, is_untimed=True, more=more)


def typical_cost(request: RenderRequest | ExportRequest | MeasureRequest) -> float:
    """The cost of an answer from a scene about which nothing is known yet."""
    if isinstance(request, RenderRequest):
        return sum(render_cost(each, TYPICAL_GAUSSIANS) for each in request.most_drawn(TYPICAL_SIZE))
    return _cost_beside_renders(request, TYPICAL_GAUSSIANS, TYPICAL_SIZE)


def cost_of(scene: TrainedScene, request: RenderRequest | ExportRequest | MeasureRequest) -> float:
    """The cost of an answer from a scene in pixels x Gaussians."""
    gaussians = len(scene.gaussians)
    if not isinstance(request, RenderRequest):
        return _cost_beside_renders(request, gaussians, (scene.intrinsics.width, scene.intrinsics.height))
    asked = seen_through(scene.intrinsics, request.camera)
    lenses = Lenses.of(asked, scene.intrinsics, request.max_pixels)
    is_judged = request.layer is Layer.CONFIDENCE
    drawn = lenses.pixels_drawn(confidence=is_judged, from_endoscope=request.is_from_endoscope)
    return sum(render_cost(each, gaussians) for each in drawn)


def _cost_beside_renders(request: ExportRequest | MeasureRequest, gaussians: int, size: tuple[int, int]) -> float:
    if isinstance(request, MeasureRequest):
        return len(request.points) * render_cost(WINDOW_PX**2, gaussians)
    return render_cost(size[0] * size[1] if request.format in DRAWN else 0, gaussians)


def _pose_and_lens(
    scene: TrainedScene, request: RenderRequest, right_eye_of_scene: Callable[[], RightEye | None]
) -> tuple[NDArray[np.float64] | None, Intrinsics]:
    """The pose of the caller's camera (None: the endoscope's left eye), and its lens before the caller's overrides.

    Raises:
        InputError: the right eye is asked for, and it is not known, or a pose is given, too.
    """
    if request.eye == "left":
        return pose_of(scene, request.pose), scene.intrinsics
    if request.pose is not None:
        raise InputError("eye", "an eye and a pose exclude each other.", "Leave out one of them.")
    registration = right_eye_of_scene()
    if registration is None:
        problem = "the right eye's camera is not known: the clip has one eye, or came with its depth."
        raise InputError("eye", problem, "Ask for eye=left.")
    return right_eye(scene, clamped_to_clip(scene, request.t)[0], registration)


def _encoded(
    frame: View,
    request: RenderRequest,
    depth_range_mm: tuple[float, float] | None,
    error: NDArray[np.float32] | None,
) -> Parts[bytes]:
    """The encoded file. A large picture takes long and cannot be encoded in parts, so another thread does it."""
    how = request.layer, request.format, request.quality, request.unseen
    encode = partial(encode_layer, frame, *how, depth_range_mm=depth_range_mm, error=error)
    with traces.span("encode", layer=request.layer.value, format=request.format.value):
        if frame.unseen.size > LARGE_PIXELS:
            return (yield from beside(encode))
        return encode()
