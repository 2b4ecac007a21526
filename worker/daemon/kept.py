"""Answers that were given, for those who ask the same again."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable

from contract.wire.rendering import RenderRequest
from worker.daemon.reply import Reply

MAX_KEPT_BYTES = 32 * 2**20


class KeptReplies:
    """Renders by request, those asked for last, of at most MAX_KEPT_BYTES in all."""

    def __init__(self, max_bytes: int = MAX_KEPT_BYTES) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._replies: OrderedDict[RenderRequest, Reply] = OrderedDict()

    def __contains__(self, request: object) -> bool:
        return request in self._replies

    def get(self, request: RenderRequest) -> Reply | None:
        """The answer that was given, if it is kept."""
        reply = self._replies.get(request)
        if reply is not None:
            self._replies.move_to_end(request)
        return reply

    def keep(self, request: RenderRequest, reply: Reply) -> None:
        """Keep an answer, in place of those asked for longest ago."""
        self.drop(lambda each: each == request)
        if len(reply.body) <= self._max_bytes // 4:
            self._replies[request] = dataclasses.replace(reply, is_kept=True)
            self._bytes += len(reply.body)
        while self._bytes > self._max_bytes:
            self._bytes -= len(self._replies.popitem(last=False)[1].body)

    def drop(self, is_out: Callable[[RenderRequest], bool]) -> None:
        """Forget the answers to these requests."""
        for request in [request for request in self._replies if is_out(request)]:
            self._bytes -= len(self._replies.pop(request).body)
