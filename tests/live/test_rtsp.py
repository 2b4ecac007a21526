"""RTSP, against GStreamer's server where it is installed, and the relay in front of it."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from intrasplat.live.state import FeedReason, FeedState
from tests.live.conftest import Open, pair_after, until, until_state
from tests.live.senders import tcp_server, video_file
from tests.live.test_sources import shown

PYTHON = "/usr/bin/python3"
PROBE = (
    "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import Gst, GstRtspServer\n"
    "Gst.init(None)\n"
    "assert all(Gst.ElementFactory.find(each) for each in ('matroskademux', 'rtph264pay'))"
)


def has_gstreamer() -> bool:
    """Whether the system's Python can serve RTSP by GStreamer."""
    return Path(PYTHON).exists() and not subprocess.run([PYTHON, "-c", PROBE], capture_output=True).returncode


@pytest.fixture
def rtsp_url(tmp_path: Path) -> Iterator[str]:
    """A stream of GStreamer's server that lasts 10 s."""
    if not has_gstreamer():
        pytest.skip("GStreamer's RTSP server is not installed (gir1.2-gst-rtsp-server-1.0, gstreamer1.0-plugins-good)")
    clip = video_file(tmp_path / "clip.mkv", 300)
    script = Path(__file__).with_name("rtsp_server.py")
    with subprocess.Popen([PYTHON, script, clip], stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield f"rtsp://127.0.0.1:{int(server.stdout.readline())}/stereo"
        finally:
            server.kill()


def test_pairs_of_an_rtsp_stream_arrive(opened: Open, rtsp_url: str) -> None:
    source = opened(rtsp_url)
    pair = pair_after(source)
    for _ in range(3):
        pair = pair_after(source, pair.sequence)
        assert shown(pair.left) == shown(pair.right, right=True)
    until(lambda: source.numbers().received_fps > 15)


def test_a_path_that_the_rtsp_server_lacks_is_refused(opened: Open, rtsp_url: str) -> None:
    source = opened(rtsp_url.replace("/stereo", "/other"))
    until_state(source, FeedState.STALLED, FeedReason.REFUSED)


def test_an_rtsp_redirect_is_not_followed(opened: Open) -> None:
    reached: list[bytes] = []

    def target(connection: socket.socket) -> None:
        reached.append(connection.recv(100))

    with tcp_server(target) as other:
        answer = f"RTSP/1.0 302 Moved\r\nCSeq: 1\r\nLocation: {other.replace('tcp', 'rtsp')}/stream\r\n\r\n"

        def serve(connection: socket.socket) -> None:
            while connection.recv(4096):
                connection.sendall(answer.encode())

        with tcp_server(serve) as url:
            source = opened(url.replace("tcp", "rtsp") + "/stream")
            until_state(source, FeedState.STALLED, FeedReason.REDIRECTED)
    assert reached == []
