"""Which recorded frames a cut is to hold, where the source's clock and the arrival of its frames went apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from intrasplat.errors import InputError
from intrasplat.live.parts import Part
from intrasplat.live.times import FeedTime
from worker.feed_cuts import _source_times

PARTS = (
    Part(Path("0.mp4"), 0, 0, 0.0, 10.0, 1000.0, 1010.0, 1),
    Part(Path("1.mp4"), 1, 1, 11.0, 21.0, 1031.0, 1041.0, 1),  # 20 s later, by the source's clock only 1 s
)


@pytest.mark.parametrize(
    ("begins", "ends", "expected"),
    [
        (FeedTime.of_source(4.0), FeedTime.of_source(8.0), (4.0, 8.0)),
        (FeedTime.of_source(4.0), FeedTime.of_source(15.0), (4.0, 15.0)),
        (FeedTime.of_source(4.0), FeedTime.at(1035.0), (4.0, 15.0)),
        (FeedTime.at(1004.0), FeedTime.at(1035.0), (4.0, 15.0)),
        (FeedTime.at(900.0), FeedTime.of_source(99.0), (0.0, 21.0)),
    ],
)
def test_seconds_of_the_source_and_of_arrival_name_the_same_frames(
    begins: FeedTime, ends: FeedTime, expected: tuple[float, float]
) -> None:
    assert _source_times(PARTS, begins, ends) == expected


def test_what_lies_beside_the_recording_is_refused() -> None:
    for begins, ends in ((FeedTime.of_source(22.0), FeedTime.at(1050.0)), (FeedTime.at(1015.0), FeedTime.at(1020.0))):
        with pytest.raises(InputError):
            _source_times(PARTS, begins, ends)
