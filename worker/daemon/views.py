"""Render and export finished scenes, which stay loaded between requests, and render the job that trains.

A scene whose folder is gone leaves memory at once: a deleted patient's tissue is neither shown nor kept.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from functools import partial

import numpy as np
from numpy.typing import NDArray

from contract.runtime import traces
from contract.runtime.settings import GIB
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest, SceneCameras
from contract.wire.errors import InputError, LimitError
from contract.wire.exports import EXPORT_FORMATS
from contract.wire.names import RECORDED
from contract.wire.notices import Notice, NoticeCode
from contract.wire.pose import MatrixPose, OrbitPose, world_from_camera
from contract.wire.rendering import (
    MEDIA_TYPES,
    TYPICAL_GAUSSIANS,
    TYPICAL_SIZE,
    ExportRequest,
    ImageFormat,
    IntrinsicsOverride,
    Layer,
    MeasureRequest,
    PictureCamera,
    RecordedMasks,
    RecordedRequest,
    RenderRequest,
    SceneRequest,
    render_cost,
)
from worker.daemon.exports import OpenExports
from worker.daemon.kept import KeptReplies
from worker.daemon.reply import NotYetError, Reply
from worker.daemon.snapshot import Snapshot, Snapshots
from worker.export import DRAWN, export_parts
from worker.input.camera import Intrinsics
from worker.machine.parts import Parts, whole
from worker.raster.backend import CPU, Device
from worker.raster.cpu.threads import beside
from worker.render.camera import endoscope_pose, right_eye
from worker.render.detail import LEVELS, thinned
from worker.render.encode import FOR_EYES, encode_layer
from worker.render.frame import Frame
from worker.render.lenses import Lenses
from worker.render.measure import WINDOW_PX
from worker.render.measured import measured
from worker.render.recorded import live_frame, stored_frame
from worker.render.view import ROUNDING, View, frame_in_parts, renderer_of
from worker.scene.checkpoint import load_scene
from worker.scene.scene import Scene
from worker.train.targets import MEDIAN_DEPTH_UNITS

COPIES = 3
"""A loaded scene takes memory three times: its tensors, the arrays of its renderer, and about as much in buffers
(measured: 100 MB more for each scene of 32 MB, of 36,000 Gaussians with 17 bases, shown at 640 x 512)."""

MEDIA_TYPE_OF_BYTES, MEDIA_TYPE_OF_JSON = "application/octet-stream", "application/json"

MAX_HELD_SCENES = 64
"""However small they are: each announcement of the worker names all of them."""


LARGE_PIXELS = 1 << 19
"""Pictures of more take so long to encode that other answers are made meanwhile."""


class Views:
    """Answers render and export requests from the scenes of a store and the snapshots of a job; for one thread.

    `held` names the scenes in memory, the last used one at the end; other threads may read it.
    """

    def __init__(
        self,
        store: Store,
        snapshots: Snapshots | None = None,
        hot_bytes: int = 2 * GIB,
        device: Device = CPU,
    ) -> None:
        self._store = store
        self._snapshots = snapshots or Snapshots()
        self._hot_bytes = hot_bytes
        self._device = device
        self._scenes: OrderedDict[tuple[str, int], Scene] = OrderedDict()
        self._kept = KeptReplies()
        self._exports = OpenExports()
        self._snapshot: Snapshot | None = None  # the last that was shown, of the job
        self._job_id = ""
        self.held: tuple[str, ...] = ()

    def answer(self, request: SceneRequest, level: int = 0) -> Reply:
        """As answer_in_parts, at once."""
        return whole(self.answer_in_parts(request, level))

    def answer_in_parts(self, request: SceneRequest, level: int = 0) -> Parts[Reply]:
        """The encoded image or file. Other answers may be made between its parts.

        Recorded frames and cameras count as kept: they say nothing of renders' time.

        level: of the LEVELS of detail, for a render in a format for eyes. Others are exact.

        Raises:
            SceneError: the scene is missing or damaged.
            NotYetError: the running job has no snapshot here yet.
            LimitError: the image would exceed request.max_pixels.
            InputError: the scene cannot be exported so, has no such eye, or nothing can be measured there.
            UnavailableError: too many exports are under way.
        """
        if isinstance(request, RecordedRequest):
            return self._recorded(request)
        if isinstance(request, ExportRequest):
            return self._export(self._stored(request.scene_id, request.attempt), request)
        if isinstance(request, MeasureRequest):
            return self._measured(self._stored(request.scene_id, request.attempt), request)
        if request.attempt is not None:
            scene, snapshot = self._stored(request.scene_id, request.attempt), None
            yield  # it may have been loaded
        else:
            snapshot = self._trained(request.scene_id)
            scene = snapshot.scene
        if isinstance(request, CamerasRequest):
            return _cameras(scene, snapshot)
        reply = self._kept.get(request)
        level = level if request.format in FOR_EYES else 0
        if reply is None or reply.level > level:
            reply = yield from self._rendered(scene, request, snapshot, level)
            # Between the parts of a render a scene may be purged, or a newer snapshot shown.
            is_held = (
                (request.scene_id, request.attempt) in self._scenes if snapshot is None else self._is_newest(scene)
            )
            if is_held:
                self._kept.keep(request, reply)
        return reply

    def cost(self, request: SceneRequest) -> float:
        """What the answer will take, in pixels x Gaussians; 0 if it is kept at full resolution."""
        if isinstance(request, RenderRequest):
            kept = self._kept.get(request)
            if kept is not None and kept.level == 0:
                return 0.0
        if isinstance(request, RecordedRequest | CamerasRequest):
            return 0.0
        if request.attempt is not None:
            scene = self._scenes.get((request.scene_id, request.attempt))
        else:
            snapshot = self._snapshots.shown(request.scene_id)
            scene = snapshot.scene if snapshot is not None else None
        gaussians = len(scene.gaussians) if scene is not None else TYPICAL_GAUSSIANS
        size = (scene.intrinsics.width, scene.intrinsics.height) if scene is not None else TYPICAL_SIZE
        if isinstance(request, MeasureRequest):
            return len(request.points) * render_cost(WINDOW_PX**2, gaussians)
        if isinstance(request, ExportRequest):
            return render_cost(size[0] * size[1] if request.format in DRAWN else 0, gaussians)
        if scene is not None:
            asked = _seen_through(scene.intrinsics, request.camera)
            is_own, is_judged = request.is_from_endoscope, request.layer is Layer.CONFIDENCE
            lenses = Lenses.of(asked, scene.intrinsics, request.max_pixels)
            drawn = lenses.pixels_drawn(confidence=is_judged, from_endoscope=is_own)
        else:
            drawn = request.most_drawn(size)
        return sum(render_cost(each, gaussians) for each in drawn)

    def forget_purged(self) -> None:
        """Drop scenes whose folders are gone, and jobs that have ended. Call it now and then."""
        for key in [key for key in self._scenes if not self._store.has_scene(*key)]:
            self._forget(key)
        self._exports.forget(lambda *key: not self._store.has_scene(*key))
        if self._snapshot is not None and self._snapshots.shown(self._job_id) is not self._snapshot:
            self._kept.drop(lambda request: request.attempt is None)
            self._snapshot = None

    def _recorded(self, request: RecordedRequest) -> Reply:
        """A recorded frame or its mask: of the job that trains, or of those that a scene keeps."""
        media_type = MEDIA_TYPES[ImageFormat.PNG if request.masks is RecordedMasks.ONLY else ImageFormat.JPEG]
        wanted = request.t, request.eye, request.masks
        if request.attempt is not None:
            path = self._store.scene_folder(request.scene_id, request.attempt) / RECORDED
            count = self._store.newest_report(request.scene_id, request.attempt).frame_count
            index, picture = stored_frame(path, count, *wanted)
            return Reply(picture, media_type, index / count, is_kept=True)
        clip, snapshot = self._snapshots.clip(request.scene_id), self._snapshots.shown(request.scene_id)
        if clip is None:
            raise NotYetError(f"The clip of job {request.scene_id} is not prepared yet.")
        index, picture = live_frame(clip, *wanted)
        iteration = 0 if snapshot is None else snapshot.iteration
        shown = index / clip.frame_count
        return Reply(picture, media_type, shown, iteration=iteration, is_kept=True)

    def _trained(self, job_id: str) -> Snapshot:
        """The newest snapshot; may wait for training, without slowing it."""
        snapshot = self._snapshots.newest(job_id)
        if snapshot is None:
            raise NotYetError(f"Job {job_id} has nothing to show yet.")
        if snapshot is not self._snapshot:
            self._kept.drop(lambda request: request.attempt is None)
            self._snapshot, self._job_id = snapshot, job_id
        return snapshot

    def _is_newest(self, scene: Scene) -> bool:
        """Whether no newer snapshot has been shown while this one was rendered."""
        return self._snapshot is not None and self._snapshot.scene is scene

    def _stored(self, scene_id: str, attempt: int) -> Scene:
        key = (scene_id, attempt)
        try:
            folder = self._store.scene_folder(scene_id, attempt)
        except Exception:
            self._forget(key)
            raise
        if key not in self._scenes:
            with traces.span("load"):
                self._scenes[key] = load_scene(folder)
        self._scenes.move_to_end(key)
        while len(self._scenes) > MAX_HELD_SCENES or (len(self._scenes) > 1 and self._byte_count() > self._hot_bytes):
            self._forget(next(iter(self._scenes)))
        self.held = tuple(name for name, _ in self._scenes)
        return self._scenes[key]

    def _rendered(self, scene: Scene, request: RenderRequest, snapshot: Snapshot | None, level: int) -> Parts[Reply]:
        """One render; snapshot: that the scene is of, None for a finished one; level: of detail."""
        pose, lens = self._standing(scene, request)
        camera = camera_of(lens, request.camera, request.max_pixels)
        size, highlights = (camera.width, camera.height), request.highlights.shown_in(request.layer)
        own = endoscope_pose(scene, shown_time(scene, request.t)) if pose is None else pose
        pose_rows = tuple(own[:3].flatten().tolist())
        taken_by = PictureCamera.model_validate({**camera.numbers(), "world_from_camera": pose_rows})
        detail = LEVELS[level]
        camera = camera.resized(-(-camera.width // detail.pixels), -(-camera.height // detail.pixels))
        drawn = thinned(scene, detail.gaussians)
        told = traces.Attributes(width=size[0], height=size[1], level=level, gaussians=len(drawn.gaussians))
        view = View(
            drawn, request.t, pose, camera, self._device,
            highlights=highlights, is_coarse=level > 0, max_pixels=request.max_pixels,
        )  # fmt: skip
        with traces.span("draw", **told):
            frame = yield from frame_in_parts(view, with_confidence=request.layer is Layer.CONFIDENCE)
        range_mm = None
        if request.layer is Layer.DEPTH and request.format in FOR_EYES:
            range_mm = renderer_of(drawn, self._device).depth_range.before(pose)
        frame = frame.enlarged(*size) if level else frame
        body = yield from _encoded(frame, request, range_mm)
        reply = _reply(scene, frame, request, snapshot, body)
        return dataclasses.replace(reply, level=level, depth_range_mm=range_mm, camera=taken_by)

    def _standing(self, scene: Scene, request: RenderRequest) -> tuple[NDArray[np.float64] | None, Intrinsics]:
        """Where the caller stands, None at the endoscope's left eye, and the lens unless another is given.

        Raises:
            InputError: it is the right eye's, and that is not known, or a pose is given, too.
        """
        if request.eye == "left":
            return pose_of(scene, request.pose), scene.intrinsics
        if request.pose is not None:
            raise InputError("eye", "an eye and a pose exclude each other.", "Leave out one of them.")
        if request.attempt is not None:
            told = self._store.newest_report(request.scene_id, request.attempt).right_eye
        else:
            clip = self._snapshots.clip(request.scene_id)
            told = None if clip is None else clip.registration
        if told is None:
            problem = "the right eye's camera is not known: the clip has one eye, or came with its depth."
            raise InputError("eye", problem, "Ask for eye=left.")
        return right_eye(scene, shown_time(scene, request.t), told)

    def _measured(self, scene: Scene, request: MeasureRequest) -> Reply:
        """A Measurement as JSON. It tells nothing of the time of renders."""
        camera = camera_of(scene.intrinsics, request.camera, request.max_pixels)
        found = measured(scene, request.t, pose_of(scene, request.pose), camera, request.points, self._device)
        return Reply(found.model_dump_json().encode(), MEDIA_TYPE_OF_JSON, found.t, found.warnings, is_kept=True)

    def _export(self, scene: Scene, request: ExportRequest) -> Reply:
        """One part of an export. It tells nothing of the time of renders."""
        content, more = self._exports.part(
            request, lambda: export_parts(scene, request.format, request.options, self._device)
        )
        known, t = EXPORT_FORMATS.get(request.format), request.options.t or 0.0
        shown, warnings = shown_time(scene, t), scene.pose_warnings
        if t > shown + ROUNDING:
            outside = f"t = {t:g} lies outside the clip; t = {shown:.4g} is exported."
            warnings = (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, outside), *warnings)
        media_type = MEDIA_TYPE_OF_BYTES if known is None else known.media_type
        return Reply(content, media_type, shown, warnings, is_kept=True, more=more)

    def _forget(self, key: tuple[str, int]) -> None:
        self._scenes.pop(key, None)
        self._kept.drop(lambda request: (request.scene_id, request.attempt) == key)
        self.held = tuple(name for name, _ in self._scenes)

    def _byte_count(self) -> int:
        return COPIES * sum(scene.byte_count for scene in self._scenes.values())


def _encoded(frame: Frame, request: RenderRequest, depth_range_mm: tuple[float, float] | None) -> Parts[bytes]:
    """The file. A large picture takes long and cannot be encoded in parts, so another thread does it."""
    how = request.layer, request.format, request.quality, request.unseen
    encode = partial(encode_layer, frame, *how, depth_range_mm=depth_range_mm)
    with traces.span("encode", layer=request.layer.value, format=request.format.value):
        if frame.unseen.size > LARGE_PIXELS:
            return (yield from beside(encode))
        return encode()


def _reply(scene: Scene, frame: Frame, request: RenderRequest, snapshot: Snapshot | None, body: bytes) -> Reply:
    """A frame as it is sent."""
    iteration = None if snapshot is None else snapshot.iteration
    warnings = frame.warnings
    if snapshot is not None:
        # What the clip shows of each place is counted when training has ended: until then nothing is vouched for.
        text = f"Training goes on: this is iteration {iteration}, and how far to trust it is not known yet."
        goes_on = Notice.warning(NoticeCode.TRAINING_GOES_ON, text)
        unknown = {NoticeCode.HARDLY_SEEN}
        if snapshot.of_one_moment:
            goes_on = Notice.warning(NoticeCode.FIRST_PICTURE, "First picture: one moment, not yet a model.")
            # It is shown at every time, and no eye has taught it.
            unknown |= {NoticeCode.TIME_OUTSIDE_CLIP, NoticeCode.HIGHLIGHTS_UNKNOWN}
        warnings = (goes_on, *(each for each in warnings if each.code not in unknown))
    shown = shown_time(scene, request.t)
    clip_size = scene.intrinsics.width, scene.intrinsics.height
    media_type, count = MEDIA_TYPES[request.format], len(scene.gaussians)
    return Reply(body, media_type, shown, warnings, iteration, frame.unseen_share, count, clip_size)


def _cameras(scene: Scene, snapshot: Snapshot | None) -> Reply:
    """The scene's SceneCameras as JSON."""
    cameras = SceneCameras.model_validate(
        {
            "intrinsics": scene.intrinsics.numbers(),
            "frame_times_s": scene.frame_times_s.tolist(),
            "world_from_camera": scene.world_from_camera.tolist(),
            "trained_t": scene.trained_t,
            "units_per_mm": scene.units_per_mm,
            "right_eye_mm": scene.right_eye_mm,
        }
    )
    iteration = None if snapshot is None else snapshot.iteration
    return Reply(cameras.model_dump_json().encode(), MEDIA_TYPE_OF_JSON, 0.0, iteration=iteration, is_kept=True)


def shown_time(scene: Scene, t: float) -> float:
    """Model time that is shown for t: after the last frame, that of the last frame."""
    return min(t, (scene.frame_count - 1) / scene.frame_count)


def pose_of(scene: Scene, pose: MatrixPose | OrbitPose | None) -> NDArray[np.float64] | None:
    """world_from_camera [4, 4], mm; None stays None, the endoscope's own pose."""
    if pose is None:
        return None
    return np.array(world_from_camera(pose, MEDIAN_DEPTH_UNITS / scene.units_per_mm), dtype=np.float64)


def camera_of(clip: Intrinsics, wanted: IntrinsicsOverride, max_pixels: int) -> Intrinsics:
    """The clip's camera with the caller's overrides.

    Raises:
        LimitError: it has more than max_pixels.
    """
    width, height = wanted.size(clip.width, clip.height)
    if width * height > max_pixels:
        problem = f"{width} x {height} is more than {max_pixels} pixels."
        raise LimitError("width", problem, "Ask for a smaller image.")
    return _seen_through(clip, wanted)


def _seen_through(clip: Intrinsics, wanted: IntrinsicsOverride) -> Intrinsics:
    """The clip's camera with the caller's overrides, of any size."""
    changes = {name: value for name in ("fx", "fy", "cx", "cy") if (value := getattr(wanted, name)) is not None}
    return dataclasses.replace(clip.resized(*wanted.size(clip.width, clip.height)), **changes)
