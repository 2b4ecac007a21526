"""The messages between the supervisor and a process that follows a feed, one JSON document per line.

supervisor -> child   FollowFeed first; then a WishFeed for each change; when stdin closes, the child ends in order
child -> supervisor   FeedReady once; FeedReported at each change of its state, and every FEED_BEAT_S
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from worker.orders import Message


class FollowFeed(Message):
    """Follow the record's feed, whose files are in `folder`; answer at the first of `endpoints` that is free."""

    kind: Literal["follow"] = "follow"
    record: FeedRecord
    folder: Path
    endpoints: tuple[str, ...]


class WishFeed(Message):
    """Run, or pause."""

    kind: Literal["wish"] = "wish"
    wish: FeedWish


class FeedReady(Message):
    """`endpoint` accepts requests."""

    kind: Literal["feed_ready"] = "feed_ready"
    endpoint: str
    device: str


class FeedReported(Message):
    """What the feed is doing now."""

    kind: Literal["feed_reported"] = "feed_reported"
    report: FeedReport


FeedOrder: TypeAlias = FollowFeed | WishFeed
FeedMessage: TypeAlias = FeedReady | FeedReported

_ORDERS: TypeAdapter[FeedOrder] = TypeAdapter(Annotated[FeedOrder, Field(discriminator="kind")])
_MESSAGES: TypeAdapter[FeedMessage] = TypeAdapter(Annotated[FeedMessage, Field(discriminator="kind")])


def read_feed_order(line: bytes) -> FeedOrder:
    """The order in a line.

    Raises:
        ValidationError: the line is not an order.
    """
    return _ORDERS.validate_json(line)


def read_feed_message(line: bytes) -> FeedMessage | None:
    """The child's message in a line; None if the line is something else."""
    try:
        return _MESSAGES.validate_json(line)
    except ValidationError:
        return None
