"""Figures of live feeds for Prometheus. The label `feed` is its id, never what its caller calls it."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator, Sequence

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from contract.wire.feeds import FeedRecord, FeedView
from intrasplat.live.state import FeedState

GAUGES: dict[str, tuple[str, Callable[[FeedView], float | None]]] = {
    "intrasplat_feed_received_fps": ("Pairs that come in a second.", lambda feed: feed.received_fps),
    "intrasplat_feed_used_fps": ("Pairs that the model learns a second.", lambda feed: feed.used_fps),
    "intrasplat_feed_model_age_seconds": (
        "Age of the newest pair that the model knows.",
        lambda feed: feed.model_age_s,
    ),
    "intrasplat_feed_decode_lag_seconds": (
        "From the arrival of a pair to its picture.",
        lambda feed: feed.decode_lag_s,
    ),
    "intrasplat_feed_stored_bytes": ("Recording and past of the model on disk.", lambda feed: feed.stored_bytes),
}
COUNTERS: dict[str, tuple[str, Callable[[FeedView], float]]] = {
    "intrasplat_feed_dropped": (
        "Whole pairs that came in and that the model did not learn.",
        lambda feed: feed.dropped,
    ),
    "intrasplat_feed_reconnects": ("Connections after the first.", lambda feed: feed.reconnects),
}


def of_feeds(records: Sequence[FeedRecord], now_s: float) -> Iterator[Metric]:
    """The figures of the open feeds at a UNIX time."""
    feeds = [FeedView.of(record, now_s) for record in records]
    states = collections.Counter(feed.state for feed in feeds)
    open_feeds = GaugeMetricFamily("intrasplat_feeds", "Open live feeds by state.", labels=("state",))
    for state in FeedState:
        open_feeds.add_metric((state.value,), states[state])
    yield open_feeds
    is_in = GaugeMetricFamily("intrasplat_feed_state", "1: the feed is in this state.", labels=("feed", "state"))
    for feed in feeds:
        is_in.add_metric((feed.id, feed.state.value), 1)
    yield is_in
    why = GaugeMetricFamily("intrasplat_feed_reason", "1: this is why it is in its state.", labels=("feed", "reason"))
    unrecorded = GaugeMetricFamily(
        "intrasplat_feed_unrecorded", "1: nothing is recorded, for this reason.", labels=("feed", "reason")
    )
    for feed in feeds:
        for gauge_of_reason, reason in ((why, feed.reason), (unrecorded, feed.recording)):
            if reason is not None:
                gauge_of_reason.add_metric((feed.id, reason.value), 1)
    yield from (why, unrecorded)
    for name, (about, gauge_of) in GAUGES.items():
        gauge = GaugeMetricFamily(name, about, labels=("feed",))
        for feed in feeds:
            if (value := gauge_of(feed)) is not None:
                gauge.add_metric((feed.id,), value)
        yield gauge
    for name, (about, count_of) in COUNTERS.items():
        counter = CounterMetricFamily(name, about, labels=("feed",))
        for feed in feeds:
            counter.add_metric((feed.id,), count_of(feed))
        yield counter
