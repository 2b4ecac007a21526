"""A stored scene's renderer on a device.

Symbols: N Gaussians, H W pixels. A scene reuses its kernels' buffers, so the second frame of a size is fast.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.machine.parts import whole
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.layout import COLOUR_ROW
from intrasplat.splat.model import ProjectedPicture
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.camera import view_camera
from intrasplat.view.depth_range import DepthRange
from intrasplat.view.detail import Detail
from intrasplat.view.out_of_view import OutOfView
from intrasplat.view.recorded_light import EndoscopeLight
from intrasplat.view.smoky import with_smoke
from intrasplat.view.unseen import blended_values


class SceneRenderer:
    """A scene ready to be rendered on a device. It serialises its threads, because the kernels share buffers.

    scene: the scene without its motion's weights, which the model contains.
    """

    def __init__(self, scene: TrainedScene, device: Device = CPU) -> None:
        self.scene = scene.without_motion()
        self._model = model_of(scene, device)
        self._values = blended_values(scene.seen.numpy())
        self._out_of_view = None if self._values is None else OutOfView.of(self.scene, self._model)
        self._lock = Lock()

    @cached_property
    def detail(self) -> Detail | None:
        """What the model misses of the recorded frames; None: they are not kept.

        Raises:
            SceneError: the recorded pictures are damaged.
        """
        return None if self.scene.pictures is None else Detail(self.scene, self.scene.pictures)

    @cached_property
    def depth_range(self) -> DepthRange:
        """The range of the false colours of depth, the same for the whole clip."""
        with self._lock:
            return DepthRange.of(self.scene, self._model)

    def layers(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Copies of R G B Z A [5, H, W], with Z unnormalised in units, and of the blended blended_values [H, W]."""
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
    ) -> Iterator[ProjectedPicture]:
        """The projected picture, to be sorted and blended in bands: planes R G B Z A, and blended_values if known.

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

    def seen_from(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics, *, detail: bool = False
    ) -> RenderedFrame:
        """The scene's colour in the light of the recording, depth in mm and alpha at model time t.

        detail: add what the model misses of the recorded frames.
        """
        image, _ = self.layers(t, world_from_camera, intrinsics)
        depth_mm = solid_depth_mm(image[3], image[4], self.scene.units_per_mm)
        rgb = image[:3].transpose(1, 2, 0)
        if detail and self.detail is not None:
            rgb = rgb + whole(self.detail.added(self, t, world_from_camera, intrinsics, depth_mm)).rgb
        light = EndoscopeLight(self.scene, t, world_from_camera, intrinsics).factors(depth_mm)
        rgb = rgb if light is None else rgb * light
        camera = (intrinsics, world_from_camera)
        return RenderedFrame(with_smoke(self.scene, t, rgb, depth_mm, camera), depth_mm, image[4])

    def values(self, t: float) -> NDArray[np.float32] | None:
        """blended_values [N] at model time t: trust where positive. None: not known."""
        if self._values is None or self._out_of_view is None:
            return self._values
        times_s = self.scene.frame_times_s
        time_s = float(np.interp(t * self.scene.frame_count, np.arange(len(times_s)), times_s))
        return self._out_of_view.faded(self._values, time_s)

    def blending_weights(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics, i: int, j: int
    ) -> NDArray[np.float32]:
        """[N] blending weights of the Gaussians at pixel (i, j)."""
        camera = view_camera(self.scene, t, world_from_camera, intrinsics)
        cotangents = np.zeros((5, intrinsics.height, intrinsics.width), np.float32)
        cotangents[0, i, j] = 1  # the gradient of a pixel's red with respect to each Gaussian's red is its weight
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
    """The scene's renderer on a device, created at its first frame there and cached as long as the scene exists."""
    with _renderers_lock:
        made = _renderers.setdefault(scene, {})
        if device not in made:
            made[device] = SceneRenderer(scene, device)
        return made[device]
