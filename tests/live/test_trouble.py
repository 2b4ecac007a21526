"""What goes wrong with a source ends in a clear state, never in a wrong picture, and ends when the source is back."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from intrasplat.errors import UnavailableError
from intrasplat.live import process
from intrasplat.live.source import Source
from intrasplat.live.spec import RecordingSpec
from intrasplat.live.state import FeedReason, FeedState
from tests.live.conftest import Open, pair_after, until, until_state
from tests.live.senders import (
    RATE_HZ,
    Stream,
    in_real_time,
    picture,
    recorded,
    send_stream,
    tcp_server,
    video_file,
)
from tests.live.test_sources import shown


def reading_pid(source: Source) -> int:
    """The id of the process that reads a source."""
    reading = source._process
    assert reading is not None
    return reading.pid


def test_a_killed_process_is_replaced_and_the_feed_goes_on_at_the_present(
    opened: Open, recording: RecordingSpec
) -> None:
    with tcp_server(send_stream) as url:
        source = opened(url, recording=recording)
        first = pair_after(source)
        until(lambda: len(source.index()) >= 2)
        before = source.index()
        killed_s = time.monotonic()
        os.kill(reading_pid(source), signal.SIGKILL)
        until_state(source, FeedState.STALLED, FeedReason.DECODER_ENDED)
        after = pair_after(source, first.sequence)
        while after.source_s < before[-1].to_s or time.time() - after.arrived_at > 0.5:
            after = pair_after(source, after.sequence)
        assert time.monotonic() - killed_s < 6.0
        assert source.numbers().reconnects >= 1
        assert source.segment is not None
        assert source.segment.reason is FeedReason.DECODER_ENDED
        assert after.source_s - first.source_s == pytest.approx(after.arrived_at - first.arrived_at, abs=0.7)
        until(lambda: len(source.index()) > len(before) + 1)
        assert source.index()[: len(before)] == before
        segments = {part.segment for part in source.index()}
        assert len(segments) == 2


def test_a_silent_source_stalls_and_is_connected_anew(opened: Open) -> None:
    def serve(connection: socket.socket) -> None:
        send_stream(connection, 30)
        time.sleep(30)

    with tcp_server(serve) as url:
        source = opened(url)
        sequence = pair_after(source).sequence
        until_state(source, FeedState.STALLED, FeedReason.SILENT)
        until(lambda: source.numbers().reconnects >= 1)
        assert pair_after(source, sequence).sequence > sequence


def test_a_source_that_is_not_there_is_found_when_it_comes(opened: Open) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    source = opened(f"tcp://127.0.0.1:{port}")
    until_state(source, FeedState.STALLED, FeedReason.UNREACHABLE)
    with tcp_server(send_stream, port):
        assert pair_after(source).sequence > 0
    until_state(source, FeedState.STALLED)


def test_garbage_is_named_and_garbage_inside_a_stream_passes(opened: Open) -> None:
    def garbage(connection: socket.socket) -> None:
        connection.sendall(b"\x00garbage" * 20_000)
        time.sleep(30)

    def damaged(connection: socket.socket) -> None:
        stream = Stream()
        for index in in_real_time():
            connection.sendall(stream.frame(picture(index)))
            if index % 12 == 5:
                connection.sendall(os.urandom(4000))

    with tcp_server(garbage) as url:
        source = opened(url)
        until_state(source, FeedState.STALLED, FeedReason.UNDECODABLE)
        assert source.newest(0, 0.1) is None
    with tcp_server(damaged) as url:
        source = opened(url)
        pair = pair_after(source)
        for _ in range(6):
            pair = pair_after(source, pair.sequence)
        assert source.numbers().reconnects == 0


def test_random_bytes_as_a_transport_stream_are_no_video(opened: Open) -> None:
    def serve(connection: socket.socket) -> None:
        while True:
            connection.sendall(b"\x47" + os.urandom(187 * 50))
            time.sleep(0.01)

    with tcp_server(serve) as url:
        until_state(opened(url), FeedState.STALLED)


def test_another_size_is_never_shown_and_the_old_one_goes_on(opened: Open) -> None:
    large = threading.Event()

    def serve(connection: socket.socket) -> None:
        stream, is_large = Stream(), False
        for index in in_real_time():
            if large.is_set() != is_large:
                stream, is_large = Stream(start_s=index / RATE_HZ), large.is_set()
            connection.sendall(stream.frame(picture(index, 64, 96) if is_large else picture(index)))

    with tcp_server(serve) as url:
        source = opened(url)
        pair = pair_after(source)
        large.set()
        until_state(source, FeedState.STALLED, FeedReason.SIZE_CHANGED)
        last = source.newest(pair.sequence, 0.1)
        assert last is None or last.left.shape == pair.left.shape
        time.sleep(0.5)
        until_state(source, FeedState.STALLED, FeedReason.SIZE_CHANGED)
        large.clear()
        after = pair_after(source, (last or pair).sequence)
        assert after.left.shape == pair.left.shape
        assert source.segment is not None
        assert source.segment.number == 1


def test_another_packing_of_the_same_size_ends_the_segment(opened: Open) -> None:
    stacked = threading.Event()

    def serve(connection: socket.socket) -> None:
        stream = Stream()
        for index in in_real_time():
            both = picture(index, 96, 64)
            if stacked.is_set():
                left, right = picture(index, 48, 128)[:, :128], picture(index, 48, 128)[:, 128:]
                both[:48], both[48:] = left, right
            connection.sendall(stream.frame(both))

    with tcp_server(serve) as url:
        source = opened(url, layout="auto")
        pair_after(source)
        assert source.segment is not None
        assert source.segment.packing == "sbs"
        stacked.set()
        until_state(source, FeedState.STALLED, FeedReason.PACKING_CHANGED)


@pytest.mark.parametrize("jump_s", [-50.0, 3600.0])
def test_times_that_jump_begin_a_segment_and_source_time_goes_on(opened: Open, jump_s: float) -> None:
    jumped = threading.Event()

    def serve(connection: socket.socket) -> None:
        stream, was = Stream(start_s=100.0), False
        for index in in_real_time():
            if jumped.is_set() and not was:
                stream, was = Stream(start_s=100.0 + index / RATE_HZ + jump_s), True
            connection.sendall(stream.frame(picture(index)))

    with tcp_server(serve) as url:
        source = opened(url)
        pair = before = pair_after(source)
        jumped.set()
        while source.segment is not None and source.segment.number == 0:
            pair, last_s = pair_after(source, pair.sequence), pair.source_s
            assert pair.source_s > last_s
        assert source.segment is not None
        assert source.segment.reason is FeedReason.TIMES_JUMPED
        assert pair.source_s - before.source_s == pytest.approx(pair.arrived_at - before.arrived_at, abs=1.0)
        assert source.numbers().reconnects == 0


def test_a_pause_ends_the_process_and_keeps_nothing(opened: Open, recording: RecordingSpec) -> None:
    with tcp_server(send_stream) as url:
        source = opened(url, recording=recording)
        pair = pair_after(source)
        until(lambda: source.index())
        pid = reading_pid(source)
        source.pause()
        assert source.state is FeedState.PAUSED
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        kept = source.index()
        assert source.newest(pair.sequence, 0.1) is None
        time.sleep(0.4)
        assert source.index() == kept
        source.resume()
        after = pair_after(source, pair.sequence)
        assert after.source_s - pair.source_s == pytest.approx(after.arrived_at - pair.arrived_at, abs=0.7)


def test_a_pause_ends_when_another_thread_resumes(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    source, wait = opened(), threading.Condition.wait
    pausing = threading.Thread(target=source.pause, daemon=True)

    def resumed_first(condition: threading.Condition, timeout: float | None = None) -> bool:
        if threading.current_thread() is pausing:
            source.resume()
        return wait(condition, timeout)

    monkeypatch.setattr(threading.Condition, "wait", resumed_first)
    pausing.start()
    pausing.join(5)
    assert not pausing.is_alive()


def test_a_push_whose_process_is_killed_must_begin_anew(opened: Open) -> None:
    source, stream = opened(), Stream("mp4")
    for index in in_real_time(40):
        source.write(stream.frame(picture(index)))
    os.kill(reading_pid(source), signal.SIGKILL)
    until_state(source, FeedState.STALLED, FeedReason.DECODER_ENDED)
    with pytest.raises(UnavailableError):
        source.write(stream.frame(picture(40)))
    stream = Stream("mp4")
    for index in in_real_time(40):
        source.write(stream.frame(picture(index)))
    assert shown(pair_after(source).left) >= 0


def test_a_process_that_lies_crashes_nothing(opened: Open, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    lies = [
        "print('nonsense')",
        "print('[1, 2]')",
        "print('{\"received\": 1e400}')",
        "print('x' * (8 << 20))",
        "os.truncate(request['pairs'], 0); print(json.dumps(line | {'pair': pair}))",
        "print(json.dumps(line | {'pair': pair | {'height': 1 << 30}}))",
        "print(json.dumps(line | {'end': 'unheard_of', 'text': ''}))",
    ]
    head = (
        "import json, os, sys\nrequest = json.loads(sys.stdin.readline())\n"
        "line = {'received': 1, 'sequence': 1, 'lag_s': 0, 'slow': False, 'last_at': None, 'problem': None,\n"
        " 'shape': [48, 64, 'sbs', 1.0], 'codec': 'h264', 'place': None, 'epoch': 0, 'parts': 0, 'recording': None}\n"
        "wish = json.loads(sys.stdin.readline())\n"
        "pair = {'want': wish['want'], 'sequence': 1, 'source_s': 0, 'arrived_at': 0, 'epoch': 0, 'height': 48,\n"
        " 'width': 64}\n"
    )
    clip = video_file(tmp_path / "clip.mkv", 2)
    for lie in lies:
        script = tmp_path / "liar.py"
        script.write_text(f"{head}{lie}\nsys.stdout.flush()\nimport time\ntime.sleep(1)\n")
        monkeypatch.setattr(process, "PROGRAM", (str(script),))
        source = opened(str(clip))
        assert source.newest(0, 0.3) is None
        until_state(source, FeedState.STALLED, FeedReason.DECODER_ENDED)
        source.close()


def test_without_a_sender_a_push_waits_for_nothing(opened: Open) -> None:
    source = opened()
    assert source.newest(0, 0.05) is None
    assert source.state is FeedState.CONNECTING
    with suppress(UnavailableError):
        source.write(b"\x00garbage" * 1000)
    until_state(source, FeedState.STALLED, FeedReason.UNDECODABLE)
    for text in (b"this is not a video", b"Good morning, feed"):
        source = opened()
        source.write(text)
        source.end_push()
        until_state(source, FeedState.STALLED)
        assert source.status.reason is not None


def test_a_push_of_an_mp4_whose_index_comes_last_is_named(opened: Open) -> None:
    source, stream = opened(), Stream("mov", crf="0")
    for index in range(120):  # more than FFmpeg's buffer, in which it may go back
        stream.frame(picture(index))
    stream.end()
    source.write(stream._buffer.getvalue())
    source.end_push()
    until_state(source, FeedState.STALLED, FeedReason.UNDECODABLE)
    assert "fragmented" in source.status.text


def test_where_a_process_failed_is_for_the_log_alone(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, opened: Open,
    tmp_path: Path,
) -> None:  # fmt: skip
    script = tmp_path / "failing.py"
    script.write_text(
        "import os\nfrom intrasplat.live import child, reader\n"
        "def failing(self): raise RuntimeError('secret')\nreader.Reader.run = failing\nchild.main()\n"
    )
    monkeypatch.setattr(process, "PROGRAM", ("-P", str(script)))
    source = opened(str(video_file(tmp_path / "clip.mkv", 2)))
    until_state(source, FeedState.STALLED, FeedReason.DECODER_ENDED)
    assert source.status.text == "the process that reads the source failed"
    assert "failing.py" in caplog.text


def test_a_process_that_hangs_is_replaced(opened: Open) -> None:
    with tcp_server(send_stream) as url:
        source = opened(url)
        sequence = pair_after(source).sequence
        pid = reading_pid(source)
        os.kill(pid, signal.SIGSTOP)
        last = source.newest(sequence, 0.2)
        until_state(source, FeedState.STALLED, FeedReason.SILENT)
        assert pair_after(source, (last.sequence if last else sequence) + 30).sequence > sequence
        assert reading_pid(source) != pid


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's protections are Linux's")
def test_the_process_has_no_socket_but_its_own_and_no_file(opened: Open) -> None:
    with tcp_server(send_stream) as url:
        source = opened(url)
        pair_after(source)
        status = Path(f"/proc/{reading_pid(source)}/status").read_text()
        assert "Seccomp:\t2" in status
        assert "NoNewPrivs:\t1" in status


def test_a_source_after_another_run_goes_on_with_its_recording(opened: Open, recording: RecordingSpec) -> None:
    data = recorded(30)

    def serve(connection: socket.socket) -> None:
        connection.sendall(data)
        time.sleep(30)

    with tcp_server(serve) as url:
        first = opened(url, recording=recording)
        until(lambda: len(first.index()) >= 2)
        first.close()
        kept = first.index()
        again = opened(url, recording=recording)
        pair = pair_after(again)
        assert pair.source_s > kept[-1].to_s
        assert again.index()[: len(kept)] == kept
        assert again.segment is not None
        assert again.segment.number == 1
