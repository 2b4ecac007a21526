"""Recorded packets: a cut equals what was sent, old parts go, a full disk stops the recording and not the feed."""

from __future__ import annotations

import io
import socket
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from intrasplat.clip import DepthClip, open_clip
from intrasplat.errors import InputError
from intrasplat.live import process
from intrasplat.live.cut import cut_parts
from intrasplat.live.parts import Parts, part_name, remove_all
from intrasplat.live.source import Source
from intrasplat.live.spec import RecordingSpec
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.options import ClipOptions
from tests.live.conftest import Open, pair_after, until, until_state
from tests.live.senders import GOP, RATE_HZ, Stream, in_real_time, picture, recorded, send_stream, tcp_server

FRAMES = 40


def frames_of(data: bytes) -> list[Any]:
    """The decoded frames of a stream, RGB."""
    with av.open(io.BytesIO(data)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.fixture
def sent() -> bytes:
    return recorded(FRAMES, bf="2", tune="animation")


@pytest.fixture
def source(opened: Open, recording: RecordingSpec, sent: bytes) -> Source:
    """A source that has recorded all of `sent`, whose last part is complete."""

    def serve(connection: socket.socket) -> None:
        connection.sendall(sent)

    with tcp_server(serve) as url:
        made = opened(url, recording=recording)
        until(lambda: made.index() and made.index()[-1].to_s > 1.2)
        made.pause()
    return made


def test_a_cut_has_the_frames_that_were_sent(source: Source, sent: bytes, tmp_path: Path) -> None:
    cut = source.cut(0.45, 0.95, tmp_path / "cut.mp4")
    assert 0.45 - GOP / RATE_HZ < cut.from_s <= 0.45 + 1 / RATE_HZ
    assert 0.95 - 1 / RATE_HZ <= cut.to_s < 0.95 + GOP / RATE_HZ
    assert cut.is_whole
    first = round(cut.from_s * RATE_HZ)
    expected, found = frames_of(sent)[first:], frames_of(cut.path.read_bytes())
    assert len(found) == cut.frames == round((cut.to_s - cut.from_s) * RATE_HZ) + 1
    for one, other in zip(found, expected, strict=False):
        np.testing.assert_array_equal(one, other)
    clip = open_clip(cut.path, options=ClipOptions(layout="sbs"))
    assert not isinstance(clip, DepthClip)
    assert clip.frame_count == cut.frames
    np.testing.assert_allclose(clip.frame_times_s, np.arange(cut.frames) / RATE_HZ, atol=1e-3)


def test_the_index_is_in_order_and_found_again(source: Source, recording: RecordingSpec) -> None:
    index = source.index()
    assert [part.number for part in index] == list(range(len(index)))
    for part, following in pairwise(index):
        assert part.from_s <= part.to_s < following.from_s
        assert part.first_arrived_at <= part.last_arrived_at <= time.time()
    assert source.numbers().stored_bytes == sum(part.path.stat().st_size for part in index)
    source.close()
    assert Parts(recording).index() == index
    assert remove_all(recording) == sum(part.bytes for part in index)
    assert Parts(recording).index() == ()


def test_a_range_that_is_not_recorded_is_named(source: Source, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not recorded"):
        source.cut(50.0, 60.0, tmp_path / "cut.mp4")
    with pytest.raises(InputError, match="is not before"):
        source.cut(1.0, 1.0, tmp_path / "cut.mp4")
    assert list(tmp_path.glob("*cut*")) == []


def test_damaged_parts_are_left_out_of_a_cut(source: Source, tmp_path: Path) -> None:
    first, second, *_ = source.index()
    first.path.write_bytes(b"garbage" * 100)
    cut = source.cut(0.0, 1.0, tmp_path / "cut.mp4")
    assert not cut.is_whole
    assert cut.from_s == pytest.approx(second.from_s)


def test_a_cut_ends_where_the_coding_changes(opened: Open, recording: RecordingSpec, tmp_path: Path) -> None:
    source = opened(recording=recording)
    for size in ((48, 64), (48, 64), (64, 96)):
        stream = Stream("mp4")
        for index in in_real_time(20):
            source.write(stream.frame(picture(index, *size)))
        source.write(stream.end())
        until(lambda: source.numbers().last_frame_at)
        source.end_push()
        until_state(source, FeedState.STALLED, FeedReason.CLOSED)
    segments = sorted({part.segment for part in source.index()})
    assert len(segments) == 3
    cut = source.cut(0.0, 100.0, tmp_path / "cut.mp4")
    assert not cut.is_whole
    assert {frame.shape for frame in frames_of(cut.path.read_bytes())} == {(64, 192, 3)}
    last = [part for part in source.index() if part.segment == segments[1]][-1]
    both = source.cut(0.0, last.to_s, tmp_path / "both.mp4")
    assert both.is_whole
    assert both.frames >= 2 * (20 - GOP)


def test_a_full_disk_stops_the_recording_and_not_the_feed(
    opened: Open, recording: RecordingSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "MAX_FILE_BYTES", 2 * 48 * 64 * 3)  # a pair, and less than a part of 4 s
    with tcp_server(lambda connection: send_stream(connection)) as url:
        source = opened(url, recording=RecordingSpec(recording.folder, part_s=60.0))
        pair = pair_after(source)
        until(lambda: source.status.recording is FeedReason.DISK_FULL)
        assert source.state is FeedState.LIVE
        assert pair_after(source, pair.sequence).sequence > pair.sequence
        assert source.numbers().reconnects == 0
        assert list(recording.folder.rglob("*.mp4")) == []
        assert list(recording.folder.rglob("*.writing")) == []


def write_part(folder: Path, number: int, arrived_at: float) -> None:
    name = part_name(number, 0, number * 2.0, number * 2.0 + 1.9, arrived_at, arrived_at + 1.9)
    (folder / name).write_bytes(bytes(1000))


def test_old_parts_go_unless_a_cut_reads_them(tmp_path: Path) -> None:
    spec = RecordingSpec(tmp_path, keep_s=10.0)
    parts = Parts(spec)
    for number in range(6):
        write_part(parts.incoming, number, time.time() - 20.0 + 4.0 * number)
    parts.adopt()
    with parts.pinned(0.0, 1.0):
        parts.prune()
        assert [part.number for part in parts.index()] == [0, 3, 4, 5]
    parts.prune()
    assert [part.number for part in parts.index()] == [3, 4, 5]
    assert parts.stored_bytes == 3000
    few = Parts(RecordingSpec(tmp_path, keep_s=10.0, max_bytes=2500))
    few.prune()
    assert [part.number for part in few.index()] == [4, 5]


def test_only_parts_are_adopted(tmp_path: Path) -> None:
    parts = Parts(RecordingSpec(tmp_path))
    now = time.time()
    write_part(parts.incoming, 99, now)
    (parts.incoming / "00000001-0-0-0-0-0.mp4").symlink_to("/etc/hostname")
    (parts.incoming / "00000002-0-0-0-0-99999999999999999999.mp4").write_bytes(b"")
    (parts.incoming / part_name(3, 0, 5.0, 4.0, now, now)).write_bytes(b"")
    (parts.incoming / part_name(4, 0, 1.0, 4.0, now, now + 1e6)).write_bytes(b"")
    parts.adopt()
    assert [(part.number, part.from_s) for part in parts.index()] == [(0, 198.0)]
    with pytest.raises(InputError, match="cannot be read"):
        cut_parts(parts, 198.0, 199.0, tmp_path / "cut.mp4")


def test_parts_grow_old_also_when_the_source_has_ended(opened: Open, recording: RecordingSpec, tmp_path: Path) -> None:
    video = tmp_path / "clip.mkv"
    video.write_bytes(recorded(FRAMES, "matroska"))
    source = opened(str(video), recording=replace(recording, keep_s=2.0))
    until_state(source, FeedState.ENDED, FeedReason.END_OF_FILE)
    assert source.index()
    until(lambda: not source.index())
