"""Render and export finished scenes, which stay loaded between requests, and render the job that trains.

A scene whose folder is gone leaves memory at once: a deleted patient's tissue is neither shown nor kept.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from contract.runtime.settings import GIB
from contract.store.store import Store
from contract.wire.errors import InputError, LimitError
from contract.wire.notices import Notice, NoticeCode
from contract.wire.pose import MatrixPose, OrbitPose, world_from_camera
from contract.wire.rendering import MEDIA_TYPES, ExportRequest, IntrinsicsOverride, RenderRequest
from worker.daemon.pace import Pace
from worker.daemon.serve import NotYetError, Reply
from worker.daemon.snapshot import Snapshots
from worker.input.camera import Intrinsics
from worker.raster.backend import CPU, Device
from worker.render.encode import encode_layer
from worker.render.view import ROUNDING, render_frame
from worker.scene.checkpoint import load_scene
from worker.scene.export import EXPORTS
from worker.scene.scene import Scene
from worker.train.targets import MEDIAN_DEPTH_UNITS

COPIES = 3
"""A loaded scene takes memory three times: its tensors, the arrays of its renderer, and about as much in buffers
(measured: 100 MB more for each scene of 32 MB, of 36,000 Gaussians with 17 bases, shown at 640 x 512)."""

MAX_HELD_SCENES = 64
"""However small they are: each announcement of the worker names all of them."""


class Views:
    """Answers render and export requests from the scenes of a store and the snapshots of a job; for one thread.

    `held` names the scenes in memory, the last used one at the end; other threads may read it.
    """

    def __init__(
        self,
        store: Store,
        snapshots: Snapshots | None = None,
        hot_bytes: int = 2 * GIB,
        pace: Pace | None = None,
        device: Device = CPU,
    ) -> None:
        self._store = store
        self._snapshots = snapshots or Snapshots()
        self._pace = pace or Pace()
        self._hot_bytes = hot_bytes
        self._device = device
        self._scenes: OrderedDict[tuple[str, int], Scene] = OrderedDict()
        self.held: tuple[str, ...] = ()

    def answer(self, request: RenderRequest | ExportRequest) -> Reply:
        """The encoded image or file.

        Raises:
            SceneError: the scene is missing or damaged.
            NotYetError: the running job has no snapshot here yet.
            LimitError: the image would exceed request.max_pixels.
            InputError: the export format does not exist.
        """
        if isinstance(request, ExportRequest):
            with self._pace.rendering():
                return _export(self._stored(request.scene_id, request.attempt), request)
        if request.attempt is not None:
            with self._pace.rendering():
                return _render(self._stored(request.scene_id, request.attempt), request, self._device)
        snapshot = self._snapshots.newest(request.scene_id)  # may wait for training, without slowing it
        if snapshot is None:
            raise NotYetError(f"Job {request.scene_id} has nothing to show yet.")
        with self._pace.rendering():
            return _render(snapshot.scene, request, self._device, snapshot.iteration)

    def forget_purged(self) -> None:
        """Drop scenes whose folders are gone. Call it now and then."""
        for key in [key for key in self._scenes if not self._store.has_scene(*key)]:
            self._forget(key)

    def _stored(self, scene_id: str, attempt: int) -> Scene:
        key = (scene_id, attempt)
        try:
            folder = self._store.scene_folder(scene_id, attempt)
        except Exception:
            self._forget(key)
            raise
        if key not in self._scenes:
            self._scenes[key] = load_scene(folder)
        self._scenes.move_to_end(key)
        while len(self._scenes) > MAX_HELD_SCENES or (len(self._scenes) > 1 and self._byte_count() > self._hot_bytes):
            self._scenes.popitem(last=False)
        self.held = tuple(name for name, _ in self._scenes)
        return self._scenes[key]

    def _forget(self, key: tuple[str, int]) -> None:
        self._scenes.pop(key, None)
        self.held = tuple(name for name, _ in self._scenes)

    def _byte_count(self) -> int:
        return COPIES * sum(scene.byte_count for scene in self._scenes.values())


def _render(scene: Scene, request: RenderRequest, device: Device, iteration: int | None = None) -> Reply:
    """One render; iteration: of a snapshot, None for a finished scene."""
    intrinsics = camera_of(scene.intrinsics, request.camera, request.max_pixels)
    highlights = request.highlights.shown_in(request.layer)
    frame = render_frame(scene, request.t, pose_of(scene, request.pose), intrinsics, device, highlights=highlights)
    body = encode_layer(frame, request.layer, request.format, request.quality, request.unseen)
    warnings = frame.warnings
    if iteration is not None:
        # What the clip shows of each place is counted when training has ended: until then nothing is vouched for.
        text = f"Training goes on: this is iteration {iteration}, and how far to trust it is not known yet."
        goes_on = Notice.warning(NoticeCode.TRAINING_GOES_ON, text)
        warnings = (goes_on, *(each for each in warnings if each.code is not NoticeCode.HARDLY_SEEN))
    shown = shown_time(scene, request.t)
    return Reply(body, MEDIA_TYPES[request.format], shown, warnings, iteration, frame.unseen_share)


def _export(scene: Scene, request: ExportRequest) -> Reply:
    """The Gaussians at time t in the requested format."""
    export_format = EXPORTS.get(request.format)
    if export_format is None:
        raise InputError("format", f"{request.format} is not an export format.", f"Use one of: {', '.join(EXPORTS)}.")
    shown = shown_time(scene, request.t)
    outside = f"t = {request.t:g} lies outside the clip; t = {shown:.4g} is exported."
    warnings = (Notice.warning(NoticeCode.TIME_OUTSIDE_CLIP, outside),) if request.t > shown + ROUNDING else ()
    return Reply(export_format.encode(scene, shown), export_format.media_type, shown, warnings)


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
    width, height = wanted.width, wanted.height
    if width is None and height is None:
        width, height = clip.width, clip.height
    elif height is None:
        assert width is not None
        height = max(1, round(width * clip.height / clip.width))
    elif width is None:
        width = max(1, round(height * clip.width / clip.height))
    if width * height > max_pixels:
        problem = f"{width} x {height} is more than {max_pixels} pixels."
        raise LimitError("width", problem, "Ask for a smaller image.")
    changes = {name: value for name in ("fx", "fy", "cx", "cy") if (value := getattr(wanted, name)) is not None}
    return dataclasses.replace(clip.resized(width, height), **changes)
