"""The moments of a feed that a caller's t names."""

from __future__ import annotations

import pytest

from contract.wire.feeds import FeedTime, feed_time
from intrasplat.errors import InputError


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("live", FeedTime(before_live_s=0)),
        ("-12.5", FeedTime(before_live_s=12.5)),
        ("31.4", FeedTime(source_s=31.4)),
        ("0", FeedTime(source_s=0)),
        ("1970-01-01T00:01:00Z", FeedTime(at_s=60)),
        ("1970-01-01T01:01:00.5+01:00", FeedTime(at_s=60.5)),
    ],
)
def test_a_moment_is_live_seconds_or_a_time(text: str, time: FeedTime) -> None:
    assert feed_time(text) == time


@pytest.mark.parametrize("text", ["", "now", "nan", "1e9", "-9999999", "2026-05-04T10:20:30", "1960-01-01T00:00:00Z"])
def test_other_texts_are_refused_with_a_remedy(text: str) -> None:
    with pytest.raises(InputError) as refused:
        feed_time(text)
    assert refused.value.field == "t"
    assert "live" in refused.value.remedy
