"""Every kind of source gives the pairs that were sent, the newest first."""

from __future__ import annotations

import io
import shutil
import socket
import ssl
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intrasplat.clip import DepthClip, open_clip
from intrasplat.errors import InputError
from intrasplat.live.spec import AllowedHosts, RecordingSpec, SourceSpec
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.options import ClipOptions
from tests.live.conftest import Open, pair_after, until, until_state
from tests.live.senders import (
    HEIGHT,
    RATE_HZ,
    WIDTH,
    Stream,
    free_port,
    http_server,
    in_real_time,
    picture,
    recorded,
    send_stream,
    tcp_server,
    video_file,
)

MAX_ERROR = 6  # grey levels, of lossy coding


def shown(eye: Any, right: bool = False) -> int:
    """The number, below 50, of the frame that an eye shows."""
    errors = [np.abs(eye.astype(int) - _half(picture(index), right)).mean() for index in range(50)]
    assert min(errors) < MAX_ERROR
    return int(np.argmin(errors))


def _half(both: Any, right: bool) -> Any:
    return both[:, WIDTH:] if right else both[:, :WIDTH]


def test_pairs_of_a_tcp_stream_come_as_sent_and_without_lag_however_slow_they_are_taken(opened: Open) -> None:
    with tcp_server(send_stream) as url:
        source = opened(url, layout="auto")
        pair = pair_after(source)
        ages_s = []
        for _ in range(8):
            time.sleep(0.25)
            pair, last = pair_after(source, pair.sequence), pair
            ages_s.append(time.time() - pair.arrived_at)
            assert pair.left.shape == pair.right.shape == (HEIGHT, WIDTH, 3)
            assert shown(pair.left) == shown(pair.right, right=True)
            assert pair.source_s - last.source_s >= (pair.sequence - last.sequence) / RATE_HZ - 1e-3
        assert np.median(ages_s) < 0.25
        assert max(ages_s) < 1.0
        numbers = source.numbers()
        assert numbers.dropped > 4 * 8
        assert 20 < numbers.received_fps < 60  # the first second came in while the process started
        assert 2 < numbers.used_fps < 6
        assert source.state is FeedState.LIVE
        assert source.segment is not None
        assert (source.segment.packing, source.segment.codec) == ("sbs", "h264")


def test_pairs_of_a_udp_stream_arrive(opened: Open) -> None:
    port = free_port()
    source = opened(f"udp://127.0.0.1:{port}")
    end = threading.Event()

    def send() -> None:
        stream = Stream()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, suppress(OSError):
            for index in in_real_time():
                data = stream.frame(picture(index))
                for place in range(0, len(data), 1316):
                    sender.sendto(data[place : place + 1316], ("127.0.0.1", port))
                if end.is_set():
                    return

    sending = threading.Thread(target=send)
    sending.start()
    try:
        pair = pair_after(source)
        assert shown(pair.left) == shown(pair.right, right=True)
        assert pair_after(source, pair.sequence).sequence > pair.sequence
    finally:
        end.set()
        sending.join()


def test_a_live_http_stream_is_read_and_a_redirect_is_not_followed(opened: Open) -> None:
    def serve(handler: Any) -> None:
        if handler.path == "/moved":
            handler.send_response(302)
            handler.send_header("Location", "/stream")
            handler.send_header("Content-Length", "0")
            handler.end_headers()
            return
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        stream = Stream()
        for index in in_real_time():
            data = stream.frame(picture(index))
            handler.wfile.write(b"%x\r\n%s\r\n" % (len(data), data))

    with http_server(serve) as url:
        pair = pair_after(opened(url))
        assert shown(pair.left) == shown(pair.right, right=True)
        moved = opened(url.replace("/stream", "/moved"))
        until_state(moved, FeedState.STALLED, FeedReason.REDIRECTED)
        assert moved.newest(0, 0.1) is None


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl on PATH")
def test_https_is_read_if_the_certificate_is_trusted(
    opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = "openssl req -x509 -newkey rsa:2048 -nodes -keyout key.pem -out cert.pem -days 2 -subj /CN=camera"
    command = [*made.split(), "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(tmp_path / "cert.pem", tmp_path / "key.pem")

    def serve(handler: Any) -> None:
        handler.send_response(200)
        handler.end_headers()
        stream = Stream("mp4")
        for index in in_real_time():
            handler.wfile.write(stream.frame(picture(index)))

    with http_server(serve, tls) as url:
        strange = opened(url)
        until_state(strange, FeedState.STALLED, FeedReason.UNREACHABLE)
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "cert.pem"))
        pair = pair_after(opened(url))
        assert shown(pair.left) == shown(pair.right, right=True)


def test_a_file_plays_in_real_time_with_the_bits_of_a_clip_and_ends(opened: Open, tmp_path: Path) -> None:
    path = video_file(tmp_path / "clip.mkv", 20)
    clip = open_clip(path, options=ClipOptions(layout="sbs"))
    assert not isinstance(clip, DepthClip)
    expected = list(clip.pairs())
    source = opened(str(path))
    began_s, found = time.monotonic(), {}
    sequence = 0
    while (pair := source.newest(sequence, 5.0)) is not None:
        sequence = pair.sequence
        found[round(pair.source_s * RATE_HZ)] = pair
    assert time.monotonic() - began_s > 19 / RATE_HZ
    assert len(found) > 10
    for index, pair in found.items():
        np.testing.assert_array_equal(pair.left, expected[index][0])
        np.testing.assert_array_equal(pair.right, expected[index][1])
    until_state(source, FeedState.ENDED, FeedReason.END_OF_FILE)


@pytest.mark.parametrize("form", ["mp4", "mpegts"])
def test_a_pushed_stream_is_read_and_another_may_follow(opened: Open, form: str) -> None:
    source = opened(recording=None)
    sequence, source_s = 0, -1.0
    for _ in range(2):
        stream = Stream(form)
        for index in in_real_time(40):
            source.write(stream.frame(picture(index)))
        pair = pair_after(source, sequence)
        assert shown(pair.left) == shown(pair.right, right=True)
        assert pair.source_s > source_s
        sequence, source_s = pair.sequence, pair.source_s
        source.end_push()
        until_state(source, FeedState.STALLED, FeedReason.CLOSED)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_pushed_pictures_are_pairs(opened: Open, recording: RecordingSpec, tmp_path: Path, suffix: str) -> None:
    source = opened(pictures=True, recording=recording)
    sent, sequence = [], 0
    for index in in_real_time(20):
        _, coded = cv2.imencode(suffix, picture(index)[:, :, ::-1])
        sent.append(coded.tobytes())
        source.write_picture(sent[-1], index / RATE_HZ)
        pair = source.newest(sequence, 0.01)
        sequence = pair.sequence if pair else sequence
    pair = pair_after(source)
    assert shown(pair.left) == shown(pair.right, right=True) == round(pair.source_s * RATE_HZ)
    source.end_push()
    until_state(source, FeedState.STALLED)
    if suffix == ".webp":
        assert source.index() == ()
        return
    cut = source.cut(0.0, 1.0, tmp_path / "cut.mkv")
    import av

    with av.open(io.BytesIO(cut.path.read_bytes())) as video:
        packets = [bytes(packet) for packet in video.demux(video=0) if packet.size]
    assert cut.container == "mkv"
    assert len(packets) == cut.frames > 10
    assert packets == sent[len(sent) - len(packets) :]
    clip = open_clip(cut.path, options=ClipOptions(layout="sbs"))
    assert not isinstance(clip, DepthClip)
    assert clip.frame_count == cut.frames


def test_two_streams_are_matched_by_time(opened: Open) -> None:
    stream = Stream()

    def serve(connection: socket.socket) -> None:
        for index in in_real_time():
            both = picture(index)
            connection.sendall(stream.frame(both[:, :WIDTH], both[:, WIDTH:]))

    with tcp_server(serve) as url:
        source = opened(url, layout="auto")
        pair = pair_after(source)
        for _ in range(3):
            pair = pair_after(source, pair.sequence)
            assert shown(pair.left) == shown(pair.right, right=True)
        assert source.segment is not None
        assert source.segment.packing == "two"


def test_hosts_have_to_be_allowed_and_their_addresses_too(opened: Open) -> None:
    with pytest.raises(InputError, match="is not allowed"):
        SourceSpec("tcp://camera.example.org:5000", hosts=AllowedHosts(("tcp://other.example.org:5000",))).target()
    with pytest.raises(InputError, match="are not allowed"):
        SourceSpec("/etc/hostname", hosts=AllowedHosts()).target()
    with tcp_server(send_stream) as url:
        private = opened(url, hosts=AllowedHosts((url,), private=False))
        until_state(private, FeedState.STALLED, FeedReason.HOST_REFUSED)
        assert pair_after(opened(url, hosts=AllowedHosts((url,), private=True))).sequence > 0


@pytest.mark.parametrize(
    "url", ["srt://host:9", "concat:a|b", "http://user:pw@host/", "tcp://host", "rtsp://", "http://host/#x", "/no/file"]
)
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(InputError) as raised:
        SourceSpec(url).target()
    assert "pw" not in str(raised.value)


def test_an_http_file_is_played_in_real_time_and_ends(opened: Open) -> None:
    data = recorded(20)

    def serve(handler: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        handler.wfile.write(data)

    with http_server(serve) as url:
        source = opened(url)
        first = pair_after(source)
        assert first.source_s < 10 / RATE_HZ
        until_state(source, FeedState.ENDED, FeedReason.END_OF_FILE)


def test_a_device_that_is_none_is_named(opened: Open) -> None:
    source = opened("v4l2:///dev/null")
    until_state(source, FeedState.STALLED, FeedReason.UNDECODABLE)
    until(lambda: source.numbers().reconnects > 0)
