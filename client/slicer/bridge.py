"""Shows a scene to OpenIGTLink peers: picture, depth, camera and status at one moment and pose, and the surface.

Views are requested only while a peer is connected, one after the other, each at the newest moment and pose. While
nothing changes, the bridge checks every CHECK_S that the scene still exists; the service answers without a picture.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from client.slicer import messages
from client.slicer.frames import Matrix, ras_from_ijk, turned, world_from_camera
from client.slicer.link import Link, first_ended
from client.slicer.playback import Playback
from client.slicer.status import Status
from client.slicer.surface import SurfaceMesh
from intrasplat.errors import InputError, SceneError
from intrasplat.pose import parse_pose
from intrasplat_client import (
    AsyncClient,
    Forbidden,
    NotFound,
    RequestRefused,
    ServiceFault,
    ServiceUnavailable,
    Unauthorized,
)
from intrasplat_client.views import Image, PictureCamera

SurfaceWhen = Literal["standing", "always", "never"]

CHECK_S = 5.0
RETRY_S = 1.0
FAREWELL_S = 3.0
"""How long sending the last messages may take."""
LOOK_S = 0.02
"""How often to check a playing clip for its next frame."""
LOOK_AROUND_S = 1.0
"""Minimum interval between measurements of median depth and confidence. They are measured when the pose changes, at the
clip's own size, for which confidence is calibrated."""
GONE = (NotFound, Unauthorized, Forbidden)
"""Permanent errors: the scene is deleted, or the key may not view it."""
AWAY = (ServiceUnavailable, ServiceFault)
"""Errors that may be temporary."""


@dataclass(frozen=True)
class ShownChoice:
    """The user's choices. width: of the picture in pixels; None: the clip's."""

    scene: str
    width: int | None = None
    depth: bool = False
    surface: SurfaceWhen = "standing"
    pose_device: str = messages.POSE


@dataclass(frozen=True)
class _PeerView:
    """A requested view: a frame, and a pose in the API's form; None: the endoscope's own."""

    frame: int
    pose: str | None


@dataclass(frozen=True)
class _Shown:
    """What peers show: a view, its picture and camera, and the depth in mm at which it is placed."""

    view: _PeerView
    image: Image
    camera: PictureCamera
    plane_mm: float


class Bridge:
    """One scene for all peers of `link`."""

    def __init__(self, client: AsyncClient, choice: ShownChoice, playback: Playback, status: Status) -> None:
        self.link = Link(self._hear, self._wake_up)
        self._client, self._choice, self._playback, self._status = client, choice, playback, status
        self._pose: str | None = None
        self._woken, self._moment = asyncio.Event(), asyncio.Event()
        self._shown: _Shown | None = None
        self._looked_at_s = -math.inf

    async def run(self, end: threading.Event) -> None:
        """Show the scene until `end` is set.

        Raises:
            IntrasplatError: the scene is gone, or the key may not view it.
        """
        ended = await first_ended(self._show(), self._surfaces(), _until(end))
        errors = [error for task in ended if (error := task.exception()) is not None]
        await self._farewell(errors[0] if errors else None)
        if errors:
            raise errors[0]

    def _hear(self, heard: messages.Heard) -> None:
        """Handle a peer's pose or command."""
        if heard.device == self._choice.pose_device and heard.matrix is not None:
            try:
                self._pose = _checked(turned(heard.matrix))
                self._status.refused = ""
            except InputError as error:
                self._status.refused = f"The pose from {heard.device} is refused: {error.problem}"
                self._send_status()
        elif heard.device == messages.COMMAND and heard.text is not None:
            self._obey(heard.text)
        self._wake_up()

    def _obey(self, command: str) -> None:
        words = command.strip().lower()
        self._status.refused = ""
        if words == "play":
            self._playback.play()
        elif words == "pause":
            self._playback.pause()
        elif words == "endoscope":
            self._pose = None
        elif (t := _time_of(words)) is not None:
            self._playback.stand_at(t)
            self._status.refused = self._playback.note_on(t)
        else:
            self._status.refused = f"{words[:40]!r} is no command. Send play, pause, t=0.4 or endoscope."
        self._send_status()

    def _wake_up(self) -> None:
        self._woken.set()

    def _send_status(self) -> None:
        self.link.send(messages.STATUS, messages.text(messages.STATUS, self._status.words()))

    async def _show(self) -> None:
        """Send pictures, one after the other."""
        while True:
            wanted = await self._next_view()
            try:
                await self._show_view(wanted)
            except AWAY as error:
                self._status.trouble = str(error)
                self._send_status()
                await asyncio.sleep(RETRY_S)

    async def _next_view(self) -> _PeerView:
        """Wait for a peer and a new view. Returns that view, or the shown one when it is time to check the scene."""
        since_s = time.monotonic()
        while True:
            self._woken.clear()
            wanted = _PeerView(self._playback.frame, self._pose)
            if self.link.has_peers and (self._shown is None or wanted != self._shown.view):
                return wanted
            if self._shown is not None and time.monotonic() - since_s > CHECK_S:
                return self._shown.view
            plays = self.link.has_peers and self._playback.plays
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S if plays else CHECK_S):
                    await self._woken.wait()

    async def _show_view(self, wanted: _PeerView) -> None:
        """Render a view and send it with camera, depth and status; nothing if it is unchanged."""
        before = self._shown
        known = before.image if before is not None and before.view == wanted else None
        image = await self._render(wanted, "rgb", self._choice.width, known)
        if image is not known:
            camera = _camera_of(image)
            plane_mm = await self._plane_mm(wanted, camera)
            place = ras_from_ijk(camera, plane_mm)
            depth = await self._render(wanted, "depth", self._choice.width) if self._choice.depth else None
            await self._send(messages.PICTURE, image.array(), place)
            if depth is not None:
                await self._send(messages.DEPTH, depth.array(), place)
            pose = turned(world_from_camera(camera))
            self.link.send(messages.CAMERA, messages.transform(messages.CAMERA, pose))
            self._shown = _Shown(wanted, image, camera, plane_mm)
        self._status.show(image, wanted.frame, follows=wanted.pose is not None)
        self._send_status()
        self._moment.set()

    async def _plane_mm(self, view: _PeerView, camera: PictureCamera) -> float:
        """The depth in mm at which the picture is placed: the median of the seen pixels. Also measures confidence."""
        before = self._shown
        is_new = before is None or before.camera.world_from_camera != camera.world_from_camera
        if before is not None and not is_new and time.monotonic() - self._looked_at_s < LOOK_AROUND_S:
            return before.plane_mm
        depth_mm = (await self._render(view, "depth", None)).array()
        confidence = (await self._render(view, "confidence", None)).array()
        seen = depth_mm > 0
        self._looked_at_s = time.monotonic()
        self._status.confidence = float(confidence[seen].mean()) if seen.any() else None
        if seen.any():
            return float(np.median(depth_mm[seen]))
        if before is None:
            raise InputError("t", "nothing of the scene is seen at this moment.", "Choose another with --t.")
        return before.plane_mm

    async def _render(self, view: _PeerView, layer: str, width: int | None, known: Image | None = None) -> Image:
        size: dict[str, Any] = {} if width is None else {"width": width}
        t = self._playback.t_of(view.frame)
        return await self._client.render(
            t, scene=self._choice.scene, pose=view.pose, layer=layer, format="npy", known=known, **size
        )

    async def _send(self, device: str, values: NDArray[np.generic], place: Matrix) -> None:
        self.link.send(device, await asyncio.to_thread(messages.image, device, values, place))

    async def _surfaces(self) -> None:
        """Send surfaces, one after the other: of a paused moment, or also of the frames that play."""
        sent: int | None = None
        while self._choice.surface != "never":
            await self._moment.wait()
            self._moment.clear()
            frame = None if self._shown is None else self._shown.view.frame
            if frame is None or frame == sent:
                continue
            if self._playback.plays and self._choice.surface == "standing" and sent is not None:
                continue
            try:
                await self._send_surface(frame)
            except AWAY as error:
                self._status.surface = f"There is no new surface yet: {error}"
                self._send_status()
                await asyncio.sleep(RETRY_S)
            else:
                sent = frame
        await asyncio.Event().wait()

    async def _send_surface(self, frame: int) -> None:
        """Send a frame's surface, or report why there is none."""
        try:
            content = await self._client.export(self._choice.scene, self._playback.t_of(frame), format="mesh-ply")
            surface = await asyncio.to_thread(SurfaceMesh.of_ply, content)
        except GONE:
            raise
        except (RequestRefused, SceneError) as error:
            self._status.surface = f"There is no surface of frame {frame}: {error}"
        else:
            self.link.send(messages.SURFACE, await asyncio.to_thread(messages.surface, messages.SURFACE, surface))
            self._status.surface = f"The surface is that of frame {frame}."
        self._send_status()

    async def _farewell(self, error: BaseException | None) -> None:
        """Tell peers why the bridge ends. The picture of a scene that they may no longer see becomes black."""
        self._status.ended = "The bridge was ended." if error is None else str(error)
        if isinstance(error, GONE) and self._shown is not None:
            camera = self._shown.camera
            place = ras_from_ijk(camera, self._shown.plane_mm)
            await self._send(messages.PICTURE, np.zeros((camera.height, camera.width, 3), np.uint8), place)
            if self._choice.depth:
                await self._send(messages.DEPTH, np.zeros((camera.height, camera.width), np.float32), place)
        self._send_status()
        await self.link.flush(FAREWELL_S)


def _camera_of(image: Image) -> PictureCamera:
    """The picture's camera.

    Raises:
        SceneError: an older service does not send it.
    """
    if image.camera is None:
        raise SceneError("The service does not tell the camera of its pictures; it is older than this program.")
    return image.camera


def _checked(pose: Matrix) -> str:
    """The pose in the API's form: 12 numbers, row-major world_from_camera in mm.

    Raises:
        InputError: it is not rigid, not finite or too far away.
    """
    text = ",".join(repr(float(each)) for each in pose[:3].ravel())
    parse_pose(text)
    return text


def _time_of(words: str) -> float | None:
    """The time in a command such as t=0.4."""
    name, _, value = words.partition("=")
    try:
        t = float(value)
    except ValueError:
        return None
    return t if name.strip() == "t" and math.isfinite(t) else None


async def _until(end: threading.Event) -> None:
    while not end.is_set():
        await asyncio.sleep(0.1)
