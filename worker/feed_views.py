"""Answer the requests of contract/wire/rendering.py from a live feed: its newest moment, and those of its past."""

from __future__ import annotations

import dataclasses
import time

from contract.wire.cameras import CamerasRequest
from contract.wire.feeds import FeedShown
from contract.wire.rendering import ExportRequest, MeasureRequest, RecordedRequest, RenderRequest, SceneRequest
from intrasplat.errors import SceneError
from intrasplat.formats import EXPORT_FORMATS
from intrasplat.live.looking import FeedMoment
from intrasplat.live.pair import FeedPair
from intrasplat.live.state import FeedState
from intrasplat.live.times import LIVE
from intrasplat.live.window import RIGHT_EYE
from intrasplat.machine.parts import Parts, whole
from intrasplat.names import Eye
from intrasplat.picture import MEDIA_TYPES, ImageFormat, RecordedMasks
from intrasplat.report import RightEye
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.view.encode import FOR_EYES
from intrasplat.view.recorded import frame_of_feed, pictured_frame, scene_picture
from worker.answer_cache import ReplyCache
from worker.exports import OpenExports
from worker.hosted_feed import HostedFeed
from worker.rendered import MEDIA_TYPE_OF_BYTES, cost_of, export_reply, measured_reply, rendered, typical_cost
from worker.reply import NotYetError, Reply


class FeedViews:
    """Answers requests for one feed; for use in one thread. Each answer names the moment that it shows."""

    def __init__(self, hosted: HostedFeed, device: Device = CPU) -> None:
        self._hosted = hosted
        self._device = device
        self._shown: TrainedScene | None = None  # the scene that was shown last
        self._replies = ReplyCache()  # of that scene
        self._exports = OpenExports()
        self._picture: tuple[tuple[int, Eye], bytes] | None = None  # the newest that was asked for
        self._exported: dict[str, FeedMoment] = {}  # the moments of the exports in progress

    def answer(self, request: SceneRequest, level: int = 0) -> Reply:
        """As answer_in_parts, in one call."""
        return whole(self.answer_in_parts(request, level))

    def answer_in_parts(self, request: SceneRequest, level: int = 0) -> Parts[Reply]:
        """As Views.answer_in_parts.

        Raises:
            SceneError: it is a request for another feed or scene, or for what a feed does not have.
            NotYetError: there is nothing to show now.
            InputError: the moment lies before the past that is stored, or as Views.answer_in_parts.
        """
        if request.scene_id != self._hosted.feed_id or isinstance(request, CamerasRequest):
            raise SceneError("This process follows a feed, and answers renders, exports and measurements of it alone.")
        if isinstance(request, RecordedRequest) and _is_of_now(request):
            picture = self._hosted.feed.picture()
            if picture is not None:
                return self._pictured(picture, request.eye)
            if self._hosted.state is FeedState.NO_TISSUE:
                raise NotYetError("The endoscope shows no tissue.")
        view = self._moment(request)
        if isinstance(request, RenderRequest):
            reply = yield from self._rendered(view, request, level)
        else:
            reply = self._other(view, request)
        return dataclasses.replace(reply, warnings=(*view.notices, *reply.warnings), feed=self._of(view))

    def cost(self, request: SceneRequest) -> float:
        """As Views.cost, with the scene that was shown last."""
        if isinstance(request, CamerasRequest | RecordedRequest):
            return 0.0
        if isinstance(request, RenderRequest) and not self._is_newer(request):
            return 0.0
        return typical_cost(request) if self._shown is None else cost_of(self._shown, request)

    def forget_idle(self) -> None:
        """End exports that their callers abandoned. Call it regularly."""
        self._exports.forget()
        self._drop_ended()

    def _moment(self, request: RenderRequest | ExportRequest | RecordedRequest | MeasureRequest) -> FeedMoment:
        """The moment that a request is for; that of an export stays that of its first part."""
        if isinstance(request, ExportRequest) and request.part > 0:
            if request.export_id not in self._exported:
                raise SceneError(f"The export of feed {request.scene_id} has ended.")
            return self._exported[request.export_id]
        view = self._hosted.feed.moment(request.moment or LIVE)
        if view is None:
            raise NotYetError("The feed shows nothing yet.")
        if isinstance(request, ExportRequest):
            self._exported[request.export_id] = view
        return view

    def _is_newer(self, request: RenderRequest) -> bool:
        """Whether the newest moment is later than the one that the caller has."""
        return request.newer_than_s is None or self._hosted.newest_s > request.newer_than_s

    def _rendered(self, view: FeedMoment, request: RenderRequest, level: int) -> Parts[Reply]:
        if request.newer_than_s is not None and view.source_s <= request.newer_than_s:
            return Reply(b"", MEDIA_TYPE_OF_BYTES, view.t, is_untimed=True)
        if view.scene is not self._shown:
            self._shown, self._replies = view.scene, ReplyCache()
        level = level if request.format in FOR_EYES else 0
        wanted = request.model_copy(update={"t": view.t, "moment": None, "newer_than_s": None})
        replies, reply = self._replies, self._replies.get(wanted)
        if reply is None or reply.level > level:
            reply = yield from rendered(
                view.scene,
                wanted,
                level,
                self._device,
                lambda: _right_eye(view.scene),
                lambda: scene_picture(view.scene, view.t, request.eye),
            )
            replies.keep(wanted, reply)
        return reply

    def _other(self, view: FeedMoment, request: ExportRequest | RecordedRequest | MeasureRequest) -> Reply:
        if isinstance(request, RecordedRequest):
            index, picture = pictured_frame(view.scene, view.t, request.eye, request.masks)
            media_type = MEDIA_TYPES[ImageFormat.PNG if request.masks is RecordedMasks.ONLY else ImageFormat.JPEG]
            return Reply(picture, media_type, index / view.scene.frame_count, is_untimed=True)
        if isinstance(request, MeasureRequest):
            return measured_reply(view.scene, request.model_copy(update={"t": view.t}), self._device)
        known = EXPORT_FORMATS.get(request.format)
        if known is not None and "t" in known.options and request.options.t is None and request.options.view is None:
            options = request.options.model_copy(update={"t": view.t})
            request = request.model_copy(update={"options": options})
        try:
            return export_reply(self._exports, view.scene, request, self._device)
        finally:
            self._drop_ended()

    def _pictured(self, pair: FeedPair, eye: Eye) -> Reply:
        """One eye of a pair as it came in, not rectified."""
        key = (pair.sequence, eye)
        if self._picture is None or self._picture[0] != key:
            self._picture = (key, frame_of_feed(pair.left if eye == "left" else pair.right))
        age_s = max(0.0, time.time() - pair.arrived_at)
        shown = FeedShown(
            state=self._hosted.state,
            source_s=pair.source_s,
            captured_at_s=pair.arrived_at,
            age_s=age_s,
            is_newest=True,
        )
        return Reply(self._picture[1], MEDIA_TYPES[ImageFormat.JPEG], 0.0, is_untimed=True, feed=shown)

    def _drop_ended(self) -> None:
        """Drop the moments of exports that have ended, with their scenes."""
        self._exported = {name: view for name, view in self._exported.items() if self._exports.is_open(name)}

    def _of(self, view: FeedMoment) -> FeedShown:
        return FeedShown(
            state=self._hosted.state,
            source_s=view.source_s,
            captured_at_s=view.captured_at,
            age_s=max(0.0, time.time() - view.captured_at),
            is_newest=view.is_live,
        )


def _is_of_now(request: RecordedRequest) -> bool:
    """Whether the newest picture is asked for, rather than one that the model knows, or its mask."""
    return request.moment in (None, LIVE) and request.masks is not RecordedMasks.ONLY


def _right_eye(scene: TrainedScene) -> RightEye | None:
    found = scene.settings.get(RIGHT_EYE)
    return None if found is None else RightEye.model_validate(found)
