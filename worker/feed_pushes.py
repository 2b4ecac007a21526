"""Take what callers push to a feed: one connection at a time, a new one takes the place of the one before."""

from __future__ import annotations

from collections import deque

from contract.wire.rendering import PUSH_REPLACED, PushRequest
from intrasplat.errors import InputError, SceneError
from worker.hosted_feed import HostedFeed
from worker.rendered import MEDIA_TYPE_OF_BYTES
from worker.reply import Reply

REMEMBERED = 64
"""Connections that have ended, whose late messages are refused."""


class FeedPushes:
    """The pushes to one feed; for use in one thread, which waits until the feed has taken each."""

    def __init__(self, hosted: HostedFeed) -> None:
        self._hosted = hosted
        self._push_id: str | None = None
        self._ended: deque[str] = deque(maxlen=REMEMBERED)

    def take(self, request: PushRequest, content: bytes) -> Reply:
        """Give the bytes to the feed.

        Raises:
            SceneError: another feed is meant.
            InputError: the feed is not pushed, or this connection has ended.
            UnavailableError: the bytes were not taken, which ends the connection.
        """
        if request.scene_id != self._hosted.feed_id:
            raise SceneError("This process follows another feed.")
        if request.push_id in self._ended:
            problem = "it has ended, or another one has taken its place."
            raise InputError(PUSH_REPLACED, problem, "Begin the push anew.")
        if request.push_id != self._push_id:
            self._end()
            self._hosted.expect(pictures=request.pictures)
            self._push_id = request.push_id
        try:
            self._hosted.feed.write(content)
        except Exception:
            self._end()
            raise
        if request.is_last:
            self._end()
        return Reply(b"", MEDIA_TYPE_OF_BYTES, 0.0, is_untimed=True)

    def _end(self) -> None:
        if self._push_id is not None:
            self._ended.append(self._push_id)
            self._push_id = None
            self._hosted.feed.end_push()
