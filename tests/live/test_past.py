"""The past of a feed: what is asked for, what is on disk, and what bounds it."""

from __future__ import annotations

import errno
import gc
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from intrasplat.errors import InputError
from intrasplat.live.looking import find_moment, range_of
from intrasplat.live.model import chosen_width
from intrasplat.live.past import MAX_WAITING, Past, PastSpec
from intrasplat.live.past_segment import WRITING, PastSegment
from intrasplat.live.state import FeedReason
from intrasplat.live.times import LIVE, FeedTime, FeedTimeKind
from intrasplat.live.window import ARRIVED_AT
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.renderer import _renderers, renderer_of
from tests.intrasplat.scenes import random_scene
from tests.live.conftest import until

NOW = time.time() - 2000.0  # each test sets it anew: a suite that takes longer than a past would make it old


@pytest.fixture(autouse=True)
def _now(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "NOW", time.time())


def scene(begins_s: float, *, step_s: float = 0.2, frames: int = 4, ago_s: float = 20.0) -> TrainedScene:
    """A small scene of frames from a second of the source on, which came in ago_s before now, plus that second."""
    made = random_scene()
    times_s = begins_s + step_s * np.arange(frames)
    arrived_at = (NOW - ago_s + times_s).tolist()
    return replace(
        made,
        world_from_camera=np.tile(np.eye(4), (frames, 1, 1)),
        frame_times_s=times_s,
        trained_t=tuple(np.arange(frames) / frames),
        settings={ARRIVED_AT: arrived_at},
    )


@pytest.mark.parametrize(
    ("text", "kind", "seconds"),
    [
        ("live", FeedTimeKind.LIVE, 0.0),
        ("-12.5", FeedTimeKind.BEFORE_LIVE, 12.5),
        (-2, FeedTimeKind.BEFORE_LIVE, 2.0),
        ("-0", FeedTimeKind.LIVE, 0.0),
        ("0", FeedTimeKind.SOURCE, 0.0),
        (1e-7, FeedTimeKind.SOURCE, 1e-7),
        ("73.25", FeedTimeKind.SOURCE, 73.25),
        ("1970-01-01T00:01:00.5Z", FeedTimeKind.UNIX, 60.5),
        ("1970-01-01T01:01:00+01:00", FeedTimeKind.UNIX, 60.0),
    ],
)
def test_a_time_is_read_in_every_form(text: str | float, kind: FeedTimeKind, seconds: float) -> None:
    assert FeedTime.parse(text) == FeedTime(kind, seconds)


@pytest.mark.parametrize(
    "text",
    [
        *("", "now", "nan", "-inf", "1e9", "1_0", "-9999999", "12 s"),
        *("1970-01-01T00:00:00", "1960-01-01T00:00:00Z", "0001-01-01T00:00:00+01:00"),
    ],
)
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(InputError) as refused:
        FeedTime.parse(text)
    assert refused.value.field == "t"


def test_a_time_zone_whose_plus_became_a_space_is_named() -> None:
    with pytest.raises(InputError, match="%2B"):
        FeedTime.parse("2026-11-29T22:44:30 01:00")


def test_a_moment_is_looked_up_in_segments_gaps_and_the_window() -> None:
    past = Past(PastSpec(keep_s=1000.0))
    for begins_s in (0.0, 0.6, 5.0):  # nothing from 1.2 to 5.0
        past.add(scene(begins_s))
    window = scene(5.6, frames=6)

    def at(when: FeedTime) -> tuple[float, int]:
        view = find_moment(when, window, past, 1.0)
        assert view is not None
        assert view.captured_at == pytest.approx(NOW - 20.0 + view.source_s, abs=1e-4)
        return view.source_s, len(view.notices)

    assert at(LIVE) == (pytest.approx(6.6), 0)
    assert at(FeedTime.before_live(0.5)) == (pytest.approx(6.1), 0)
    assert at(FeedTime.of_source(0.7)) == (pytest.approx(0.7), 0)
    assert at(FeedTime.of_source(2.0)) == (pytest.approx(1.2), 1)
    assert at(FeedTime.of_source(4.0)) == (pytest.approx(5.0), 1)
    assert at(FeedTime.of_source(9.0)) == (pytest.approx(6.6), 1)
    assert at(FeedTime.at(NOW - 20.0 + 5.3)) == (pytest.approx(5.3, abs=1e-3), 0)
    for early in (FeedTime.of_source(-1.0), FeedTime.before_live(7.0), FeedTime.at(NOW - 30.0)):
        with pytest.raises(InputError, match="before the past"):
            at(early)


def test_of_a_feed_that_goes_on_what_the_model_has_not_come_to_yet_is_no_gap() -> None:
    past, window = Past(PastSpec(keep_s=1000.0)), scene(0.0, frames=6)
    newest_s, newest_at = 1.0, NOW - 19.0

    def codes(when: FeedTime, *, goes_on: bool, max_age_s: float = 1000.0) -> list[str]:
        view = find_moment(when, window, past, max_age_s, goes_on=goes_on)
        assert view is not None
        assert (view.source_s, view.is_live) == (pytest.approx(newest_s), True)
        return [each.code for each in view.notices]

    age_s = time.time() - newest_at
    for when in (FeedTime.at(time.time() - 0.5), FeedTime.of_source(newest_s + age_s - 0.5)):
        assert codes(when, goes_on=True) == []
        assert codes(when, goes_on=False) == ["time_in_gap"]
        assert codes(when, goes_on=True, max_age_s=1.0) == ["time_in_gap"]  # it may be of before an outage
    for later in (FeedTime.at(time.time() + 30.0), FeedTime.of_source(newest_s + age_s + 30.0)):
        assert codes(later, goes_on=True) == ["time_in_gap"]
    for future in (FeedTime.at(time.time() + 100.0), FeedTime.of_source(newest_s + age_s + 100.0)):
        with pytest.raises(InputError, match="future"):
            codes(future, goes_on=True)


def test_between_frames_that_are_far_apart_the_nearer_one_is_shown() -> None:
    past = Past(PastSpec(keep_s=1000.0))
    past.add(scene(0.0, step_s=4.0))
    for wanted_s, shown_s in ((1.5, 0.0), (2.5, 4.0)):
        view = find_moment(FeedTime.of_source(wanted_s), None, past, 1.0)
        assert view is not None
        assert view.source_s == pytest.approx(shown_s)
        assert view.t * 4 == pytest.approx(round(view.t * 4))
        assert [each.code for each in view.notices] == ["time_in_gap"]


def test_nothing_is_known_at_first() -> None:
    past = Past(PastSpec())
    assert range_of(None, past) is None
    assert find_moment(LIVE, None, past, 1.0) is None


def test_segments_are_stored_and_loaded_when_they_are_looked_at(tmp_path: Path) -> None:
    past = Past(PastSpec(tmp_path, keep_s=1000.0, cached=2))
    for number in range(5):
        past.add(scene(0.6 * number))
        until(lambda: all(each.path is not None for each in past.segments()))
    past.add(scene(3.0))
    assert len(past._scenes) <= 3
    first = past.segments()[0]
    loaded = past.load(first)
    assert loaded is not None
    assert np.allclose(loaded.frame_times_s, scene(0.0).frame_times_s)
    past.close()
    assert past.stored_bytes == sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    again = Past(PastSpec(tmp_path, keep_s=1000.0))
    assert np.allclose([each.source_s for each in again.segments()], [each.source_s for each in past.segments()])
    again.close()


def test_old_and_too_many_segments_are_deleted(tmp_path: Path) -> None:
    past = Past(PastSpec(tmp_path, keep_s=1000.0))
    for number in range(4):
        past.add(scene(0.6 * number))
    past.close()
    size = past.stored_bytes // 4
    fewer = Past(PastSpec(tmp_path, keep_s=1000.0, max_bytes=2 * size + size // 2))
    assert [round(each.source_s[0], 1) for each in fewer.segments()] == [1.2, 1.8]
    fewer.close()
    none = Past(PastSpec(tmp_path, keep_s=1.0))
    assert none.segments() == ()
    assert not any(tmp_path.iterdir())
    none.close()


def test_a_past_in_memory_is_bounded_by_bytes() -> None:
    size = scene(0.0).byte_count
    past = Past(PastSpec(keep_s=1000.0, max_bytes=3 * size))
    for number in range(10):
        past.add(scene(0.6 * number))
        past.prune()
    assert [each.number for each in past.segments()] == [7, 8, 9]
    assert past.stored_bytes == 0
    assert len(past._scenes) == 3


def test_a_past_in_memory_drops_what_was_made_to_render_it() -> None:
    past = Past(PastSpec(keep_s=1000.0, cached=2))
    for number in range(5):
        past.add(scene(0.6 * number))
    gc.collect()
    before = len(_renderers)
    for segment in past.segments():
        shown = past.load(segment)
        assert shown is not None
        renderer_of(shown)
    del shown
    gc.collect()
    assert len(_renderers) - before == 2


def test_a_damaged_segment_is_left_out_and_the_nearest_one_is_shown(tmp_path: Path) -> None:
    past = Past(PastSpec(tmp_path, keep_s=1000.0))
    for begins_s in (0.0, 5.0, 10.0):
        past.add(scene(begins_s))
    past.close()
    again = Past(PastSpec(tmp_path, keep_s=1000.0))
    damaged = again.segments()[1].path
    assert damaged is not None
    (damaged / "scene.safetensors").write_bytes(b"no")
    view = find_moment(FeedTime.of_source(5.2), None, again, 1.0)
    assert view is not None
    assert view.source_s == pytest.approx(0.6)
    assert len(again.segments()) == 2
    again.close()


def test_a_full_disk_stops_the_segments_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    past = Past(PastSpec(tmp_path, keep_s=1000.0, cached=2))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    past.add(scene(0.0))
    until(lambda: past.problem is FeedReason.DISK_FULL)
    for number in range(1, 2 * MAX_WAITING + 8):
        past.add(scene(0.6 * number))
    assert len(past.segments()) <= 2 + 2 * MAX_WAITING  # memory is bounded
    assert past.load(past.segments()[-1]) is not None
    monkeypatch.undo()
    until(lambda: past._queue.empty())
    past.add(scene(30.0))
    until(lambda: past.segments()[-1].path is not None)
    assert past.problem is None
    past.close()


def test_a_disk_that_refuses_leaves_no_draft(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    past = Past(PastSpec(tmp_path, keep_s=1000.0))

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("intrasplat.live.past_segment.move_folder", refuse)
    past.add(scene(0.0))
    until(lambda: past.problem is FeedReason.DISK_FULL)
    past.close()
    assert not any(tmp_path.iterdir())


WRITER = """
import itertools, sys
from pathlib import Path
from intrasplat.live.past_segment import PastSegment
from tests.live.test_past import scene
for number in itertools.count():
    segment = scene(0.6 * number)
    PastSegment.of(number, segment).written(Path(sys.argv[1]), segment)
    print(number, flush=True)
"""


def test_after_a_kill_every_segment_that_was_acknowledged_is_there(tmp_path: Path) -> None:
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    acknowledged = [int(writer.stdout.readline()) for _ in range(3)][-1]
    time.sleep(0.013)
    writer.send_signal(signal.SIGKILL)
    acknowledged = max([acknowledged, *map(int, writer.communicate()[0].split())])
    past = Past(PastSpec(tmp_path, keep_s=1e6))
    assert [each.number for each in past.segments()][: acknowledged + 1] == list(range(acknowledged + 1))
    assert all(past.load(each) is not None for each in past.segments())
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(WRITING)]
    past.close()


def test_a_name_that_is_none_is_no_segment(tmp_path: Path) -> None:
    (tmp_path / "00000001-0-600000").mkdir()
    assert PastSegment.at(tmp_path / "00000001-0-600000") is None


@pytest.mark.parametrize(
    ("steps", "width", "recorded", "chosen"),
    [(12, 320, 1920, 320), (200, 320, 1920, 960), (60, 320, 1920, 640), (60, 320, 400, 400), (3, 320, 1920, 240)],
)
def test_the_width_is_what_leaves_steps_enough(steps: float, width: int, recorded: int, chosen: int) -> None:
    assert chosen_width(steps, width, recorded) == chosen
