"""What tests of live sources share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from intrasplat.live.eyes import EyesSettings
from intrasplat.live.feed import Feed, FeedSettings
from intrasplat.live.follow import FollowSettings
from intrasplat.live.pair import FeedPair
from intrasplat.live.source import Source
from intrasplat.live.spec import BackOff, Deadlines, RecordingSpec, SourceSpec
from intrasplat.live.state import FeedReason, FeedState
from lab.phantom import Phantom, PhantomSettings, make_phantom
from tests.live.senders import PhantomSender

SHORT = Deadlines(connect_s=2.0, first_s=6.0, silent_s=0.6, read_s=1.2)
SOON = BackOff(first_s=0.1, most_s=0.2)
WAIT_S = 15.0

Open = Callable[..., Source]
Follow = Callable[..., Feed]


@pytest.fixture
def opened() -> Iterator[Open]:
    """Opens sources with short deadlines, and closes them after the test."""
    sources: list[Source] = []

    def open_one(url: str | None = None, **more: object) -> Source:
        given = {"layout": "sbs", "deadlines": SHORT, "back_off": SOON} | more
        sources.append(Source(SourceSpec(url, **given)))  # type: ignore[arg-type]
        return sources[-1]

    yield open_one
    for source in sources:
        source.close()


@pytest.fixture
def recording(tmp_path: Path) -> RecordingSpec:
    """Parts of a fifth of a second, a key frame's distance."""
    return RecordingSpec(tmp_path / "recording", part_s=0.2)


def pair_after(source: Source, sequence: int = 0) -> FeedPair:
    """The next pair, which has to come."""
    pair = source.newest(sequence, WAIT_S)
    assert pair is not None, source.status
    return pair


def until(holds: Callable[[], object], what: object = "") -> None:
    """Wait until something holds, which has to come true."""
    deadline_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline_s, what() if callable(what) else what
        time.sleep(0.02)


def until_state(source: Source, state: FeedState, reason: FeedReason | None = None) -> None:
    """Wait until a source is in a state, for a reason if one is given."""
    until(
        lambda: source.status.state is state and (reason is None or source.status.reason is reason),
        lambda: source.status,
    )


FOLLOW = FollowSettings(EyesSettings(finds_instruments=False), segment_frames=3, points=2000)
FEED = FeedSettings(width=128, keep_s=60.0, budget_s=0.05, follow=FOLLOW)


@cache
def phantom() -> Phantom:
    return make_phantom(PhantomSettings(128, 96, 24, "breathing", 0, tools=(), period_frames=24, frame_rate_hz=10.0))


@pytest.fixture
def sender() -> Iterator[PhantomSender]:
    with PhantomSender(phantom()).serving() as serving:
        yield serving


@pytest.fixture
def followed(sender: PhantomSender) -> Iterator[Follow]:
    """Follows the phantom's feed, with other settings if given."""
    feeds: list[Feed] = []

    def follow(settings: FeedSettings = FEED, recording: RecordingSpec | None = None, **more: object) -> Feed:
        given = {"layout": "sbs", "deadlines": SHORT, "back_off": SOON, "recording": recording} | more
        feeds.append(Feed(SourceSpec(sender.url, **given), sender.calibration, settings))  # type: ignore[arg-type]
        return feeds[-1]

    yield follow
    for feed in feeds:
        feed.close()


def until_known(feed: Feed, seconds: float) -> float:
    """Wait until so many seconds are known; the newest one's source time."""
    until(lambda: (past := feed.report().past) and past.ends_s - past.begins_s > seconds, feed.report)
    past = feed.report().past
    assert past is not None
    return past.ends_s
