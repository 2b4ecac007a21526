"""A cache of replies to render requests."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable

from contract.wire.rendering import RenderRequest
from worker.reply import Reply

MAX_CACHE_BYTES = 32 * 2**20


class ReplyCache:
    """The most recently used replies by request, of at most MAX_CACHE_BYTES in all."""

    def __init__(self) -> None:
        self._bytes = 0
        self._replies: OrderedDict[RenderRequest, Reply] = OrderedDict()

    def __contains__(self, request: object) -> bool:
        return request in self._replies

    def get(self, request: RenderRequest) -> Reply | None:
        """The cached reply; None if there is none."""
        reply = self._replies.get(request)
        if reply is not None:
            self._replies.move_to_end(request)
        return reply

    def keep(self, request: RenderRequest, reply: Reply) -> None:
        """Store a reply; drop the least recently used ones to make space."""
        self.drop(lambda each: each == request)
        if len(reply.body) <= MAX_CACHE_BYTES // 4:
            self._replies[request] = dataclasses.replace(reply, is_untimed=True)
            self._bytes += len(reply.body)
        while self._bytes > MAX_CACHE_BYTES:
            self._bytes -= len(self._replies.popitem(last=False)[1].body)

    def drop(self, is_out: Callable[[RenderRequest], bool]) -> None:
        """Drop the replies to these requests."""
        for request in [request for request in self._replies if is_out(request)]:
            self._bytes -= len(self._replies.pop(request).body)
