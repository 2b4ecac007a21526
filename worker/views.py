"""Renders and exports of finished scenes, which stay loaded between requests.

A scene whose folder is gone is forgotten at once: a deleted patient's tissue is not shown from memory.
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from contract.camera import Intrinsics
from contract.errors import LimitError
from contract.pose import MatrixPose, OrbitPose, world_from_camera
from contract.rendering import MEDIA_TYPES, ExportRequest, IntrinsicsOverride, RenderRequest
from contract.store import Store
from worker.checkpoint import Scene, load_scene
from worker.encode import encode_layer
from worker.export import export_ply
from worker.render import ROUNDING, render_frame
from worker.serve import View
from worker.targets import MEDIAN_DEPTH_UNITS

LOADED_SCENES = 4
"""Scenes kept in memory; a scene of a hundred thousand Gaussians is some tens of MB."""


class Views:
    """Answers render and export requests from the scenes of a store; for one thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._scenes: OrderedDict[str, Scene] = OrderedDict()

    def answer(self, request: RenderRequest | ExportRequest) -> View:
        """The encoded image or file.

        Raises:
            SceneError: the scene is not there, or damaged.
            LimitError: the image would have more than request.max_pixels.
        """
        scene = self._scene(request.scene_id)
        if isinstance(request, ExportRequest):
            shown = shown_time(scene, request.t)
            outside = f"t = {request.t:g} lies outside the clip; t = {shown:.4g} is exported."
            warnings = (outside,) if request.t > shown + ROUNDING else ()
            return View(export_ply(scene, shown), "application/octet-stream", shown, warnings)
        intrinsics = camera_of(scene.intrinsics, request.camera, request.max_pixels)
        frame = render_frame(scene, request.t, pose_of(scene, request.pose), intrinsics)
        body = encode_layer(frame, request.layer, request.format)
        return View(body, MEDIA_TYPES[request.format], shown_time(scene, request.t), frame.warnings)

    def _scene(self, scene_id: str) -> Scene:
        try:
            folder = self._store.scene_folder(scene_id)
        except Exception:
            self._scenes.pop(scene_id, None)
            raise
        if scene_id not in self._scenes:
            self._scenes[scene_id] = load_scene(folder)
        self._scenes.move_to_end(scene_id)
        while len(self._scenes) > LOADED_SCENES:
            self._scenes.popitem(last=False)
        return self._scenes[scene_id]


def shown_time(scene: Scene, t: float) -> float:
    """Model time that is shown for t: after the last frame nothing is known, so the last frame's stands."""
    return min(t, (scene.frame_count - 1) / scene.frame_count)


def pose_of(scene: Scene, pose: MatrixPose | OrbitPose | None) -> NDArray[np.float64] | None:
    """world_from_camera [4, 4], mm; None stays None, the endoscope's own pose."""
    if pose is None:
        return None
    return np.array(world_from_camera(pose, MEDIAN_DEPTH_UNITS / scene.units_per_mm), dtype=np.float64)


def camera_of(clip: Intrinsics, wanted: IntrinsicsOverride, max_pixels: int) -> Intrinsics:
    """The clip's camera with what the caller wants otherwise.

    Raises:
        LimitError: more than max_pixels.
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
    return clip.resized(width, height).model_copy(update=changes)
