"""Answer the requests of contract/wire/rendering.py from finished scenes and from the job in training.

    RenderRequest, RecordedRequest, CamerasRequest   a finished scene or the job in training
    ExportRequest, MeasureRequest                    finished scenes only

Scenes stay loaded between requests. A scene whose folder was removed leaves memory at once: a deleted patient's tissue
is neither shown nor stored.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict

from contract.runtime import traces
from contract.runtime.settings import GIB
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest, SceneCameras
from contract.wire.rendering import (
    ExportRequest,
    MeasureRequest,
    RecordedRequest,
    RenderRequest,
    SceneRequest,
)
from intrasplat.machine.parts import Parts, whole
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import MEDIA_TYPES, ImageFormat, RecordedMasks
from intrasplat.report import RightEye
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.view.detail import detail_bytes
from intrasplat.view.encode import FOR_EYES
from intrasplat.view.recorded import RecordedPicture, clip_picture, live_frame, stored_frame, stored_picture
from worker.answer_cache import ReplyCache
from worker.exports import OpenExports
from worker.rendered import MEDIA_TYPE_OF_JSON, cost_of, export_reply, measured_reply, rendered, typical_cost
from worker.reply import NotYetError, Reply
from worker.snapshot import Snapshot, Snapshots

COPIES = 3
"""A loaded scene takes three times its size in memory: its tensors, the arrays of its renderer, and about as much in
buffers (measured: 100 MB for each scene of 32 MB, with 36,000 Gaussians and 17 bases, shown at 640 x 512)."""

MAX_CACHED_SCENES = 64
"""Most scenes in memory, however small: each announcement of the worker names all of them."""


class Views:
    """Answers requests from a store's scenes and a job's snapshots; for use in one thread.

    `cached` names the scenes in memory, with the last used one at the end; other threads may read it.
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
        self._scenes: OrderedDict[tuple[str, int], TrainedScene] = OrderedDict()
        self._replies = ReplyCache()
        self._exports = OpenExports()
        self._snapshot: Snapshot | None = None  # the job's snapshot that was shown last
        self._job_id = ""
        self.cached: tuple[str, ...] = ()

    def answer(self, request: SceneRequest, level: int = 0) -> Reply:
        """As answer_in_parts, in one call."""
        return whole(self.answer_in_parts(request, level))

    def answer_in_parts(self, request: SceneRequest, level: int = 0) -> Parts[Reply]:
        """The encoded image or file. Other answers may be computed between its parts.

        Recorded frames and cameras have is_untimed set: their time does not predict that of renders.

        level: index into LEVELS of detail, for renders as jpeg or webp. Other formats are exact.

        Raises:
            SceneError: the scene is missing or damaged.
            NotYetError: the running job has no snapshot here yet.
            LimitError: the image would exceed request.max_pixels.
            InputError: the scene does not allow this export, has no such eye, or nothing can be measured there.
            UnavailableError: too many exports are in progress.
        """
        if isinstance(request, RecordedRequest):
            return self._recorded(request)
        if isinstance(request, ExportRequest):
            return export_reply(self._exports, self._stored(request.scene_id, request.attempt), request, self._device)
        if isinstance(request, MeasureRequest):
            return measured_reply(self._stored(request.scene_id, request.attempt), request, self._device)
        if request.attempt is not None:
            scene, snapshot = self._stored(request.scene_id, request.attempt), None
            yield  # loading the scene may have taken long
        else:
            snapshot = self._newest_snapshot(request.scene_id)
            scene = snapshot.scene
        if isinstance(request, CamerasRequest):
            return _cameras(scene, snapshot)
        reply = self._replies.get(request)
        level = level if request.format in FOR_EYES else 0
        if reply is None or reply.level > level:
            reply = yield from rendered(
                scene, request, level, self._device, lambda: self._right_eye(request), lambda: self._picture(request)
            )
            reply = reply if snapshot is None else _of_snapshot(reply, snapshot)
            # Between the parts of a render, a scene may be purged or a newer snapshot shown.
            is_current = (
                (request.scene_id, request.attempt) in self._scenes if snapshot is None else self._is_newest(scene)
            )
            if is_current:
                self._replies.keep(request, reply)
        return reply

    def cost(self, request: SceneRequest) -> float:
        """The cost of the answer in pixels x Gaussians; 0 if it is cached at full detail."""
        if isinstance(request, RenderRequest):
            cached = self._replies.get(request)
            if cached is not None and cached.level == 0:
                return 0.0
        if isinstance(request, RecordedRequest | CamerasRequest):
            return 0.0
        if request.attempt is not None:
            scene = self._scenes.get((request.scene_id, request.attempt))
        else:
            snapshot = self._snapshots.shown(request.scene_id)
            scene = snapshot.scene if snapshot is not None else None
        return typical_cost(request) if scene is None else cost_of(scene, request)

    def forget_purged(self) -> None:
        """Drop scenes whose folders were removed, and jobs that have ended. Call it regularly."""
        for key in [key for key in self._scenes if not self._store.has_scene(*key)]:
            self._forget(key)
        self._exports.forget(lambda *key: not self._store.has_scene(*key))
        if self._snapshot is not None and self._snapshots.shown(self._job_id) is not self._snapshot:
            self._replies.drop(lambda request: request.attempt is None)
            self._snapshot = None

    def _recorded(self, request: RecordedRequest) -> Reply:
        """A recorded frame or its mask, of the job in training or from a scene's file."""
        media_type = MEDIA_TYPES[ImageFormat.PNG if request.masks is RecordedMasks.ONLY else ImageFormat.JPEG]
        wanted = request.t, request.eye, request.masks
        if request.attempt is not None:
            folder = self._store.scene_folder(request.scene_id, request.attempt)
            count = self._store.newest_report(request.scene_id, request.attempt).frame_count
            index, picture = stored_frame(folder, count, *wanted)
            return Reply(picture, media_type, index / count, is_untimed=True)
        clip, snapshot = self._snapshots.clip(request.scene_id), self._snapshots.shown(request.scene_id)
        if clip is None:
            raise NotYetError(f"The clip of job {request.scene_id} is not prepared yet.")
        index, picture = live_frame(clip, *wanted)
        iteration = 0 if snapshot is None else snapshot.iteration
        shown = index / clip.frame_count
        return Reply(picture, media_type, shown, iteration=iteration, is_untimed=True)

    def _newest_snapshot(self, job_id: str) -> Snapshot:
        """The newest snapshot; may wait for training, without slowing it."""
        snapshot = self._snapshots.newest(job_id)
        if snapshot is None:
            raise NotYetError(f"Job {job_id} has nothing to show yet.")
        if snapshot is not self._snapshot:
            self._replies.drop(lambda request: request.attempt is None)
            self._snapshot, self._job_id = snapshot, job_id
        return snapshot

    def _is_newest(self, scene: TrainedScene) -> bool:
        """Whether no newer snapshot was shown while this one was rendered."""
        return self._snapshot is not None and self._snapshot.scene is scene

    def _stored(self, scene_id: str, attempt: int) -> TrainedScene:
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
        while len(self._scenes) > MAX_CACHED_SCENES or (len(self._scenes) > 1 and self._byte_count() > self._hot_bytes):
            self._forget(next(iter(self._scenes)))
        self.cached = tuple(name for name, _ in self._scenes)
        return self._scenes[key]

    def _right_eye(self, request: RenderRequest) -> RightEye | None:
        """What is known of the right eye of a scene, or of a job in training."""
        if request.attempt is not None:
            return self._store.newest_report(request.scene_id, request.attempt).right_eye
        clip = self._snapshots.clip(request.scene_id)
        return None if clip is None else clip.registration

    def _picture(self, request: RenderRequest) -> RecordedPicture:
        """The recorded frame nearest to a render's time."""
        if request.attempt is not None:
            folder = self._store.scene_folder(request.scene_id, request.attempt)
            count = self._store.newest_report(request.scene_id, request.attempt).frame_count
            return stored_picture(folder, count, request.t, request.eye)
        clip = self._snapshots.clip(request.scene_id)
        if clip is None:
            raise NotYetError(f"The clip of job {request.scene_id} is not prepared yet.")
        return clip_picture(clip, request.t, request.eye)

    def _forget(self, key: tuple[str, int]) -> None:
        self._scenes.pop(key, None)
        self._replies.drop(lambda request: (request.scene_id, request.attempt) == key)
        self.cached = tuple(name for name, _ in self._scenes)

    def _byte_count(self) -> int:
        return sum(COPIES * scene.byte_count + detail_bytes(scene) for scene in self._scenes.values())


def _of_snapshot(reply: Reply, snapshot: Snapshot) -> Reply:
    """The reply with a rendered frame of a snapshot."""
    # `seen` is computed only when training has ended, so until then the trust is unknown.
    text = f"Training goes on: this is iteration {snapshot.iteration}, and how far to trust it is not known yet."
    goes_on = Notice.warning(NoticeCode.TRAINING_GOES_ON, text)
    unknown = {NoticeCode.HARDLY_SEEN}
    if snapshot.of_one_moment:
        goes_on = Notice.warning(NoticeCode.FIRST_PICTURE, "First picture: one moment, not yet a model.")
        # One moment is shown at every time, and no eye has trained the scene.
        unknown |= {NoticeCode.TIME_OUTSIDE_CLIP, NoticeCode.HIGHLIGHTS_UNKNOWN}
    warnings = (goes_on, *(each for each in reply.warnings if each.code not in unknown))
    return dataclasses.replace(reply, warnings=warnings, iteration=snapshot.iteration)


def _cameras(scene: TrainedScene, snapshot: Snapshot | None) -> Reply:
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
    return Reply(cameras.model_dump_json().encode(), MEDIA_TYPE_OF_JSON, 0.0, iteration=iteration, is_untimed=True)
