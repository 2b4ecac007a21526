"""A service with a scene, the bridge as a process of its own, and a peer that pyigtl makes."""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyigtl
from numpy.typing import NDArray
from pyigtl.messages import message_type_to_class_constructor

from contract.queue.embedded import short_socket_path
from contract.store.store import Store
from contract.wire.names import REPORT
from tests.client.page import Painter, Site
from tests.reports import REPORT_OF_A_SCENE, a_warning
from tests.test_repository import REPOSITORY
from tests.worker.export.sheet import tissue
from worker.daemon.pace import Pace
from worker.daemon.scheduler import Scheduler
from worker.daemon.serve import RequestServer
from worker.daemon.views import Views
from worker.render.view import render_frame
from worker.scene.checkpoint import save_scene

WAIT_S = 60.0
DOUBT = "The clip is short."
OPENED = re.compile(r"OpenIGTLink at 127\.0\.0\.1:(\d+)")


class ReadPolyData(pyigtl.PolyDataMessage):  # type: ignore[misc]
    """POLYDATA as the protocol describes it; pyigtl writes it and does not read it."""

    def _unpack_content(self, content: bytes) -> None:
        counts = struct.unpack_from(">10I", content)
        assert [counts[each] for each in (1, 2, 3, 4, 7, 8)] == [0] * 6
        at = 40
        self.points = np.frombuffer(content, ">f4", 3 * counts[0], at).reshape(-1, 3)
        at += self.points.nbytes
        cells = np.frombuffer(content, ">u4", counts[6] // 4, at).reshape(counts[5], -1)
        assert (cells[:, 0] == 3).all()
        self.polygons = cells[:, 1:]
        at += counts[6]
        assert counts[9] == 1
        kind, components, count = struct.unpack_from(">BBI", content, at)
        name, _, _ = content[at + 6 :].partition(b"\0")
        at += 6 + len(name) + 1 + (len(name) + 1) % 2
        self.attributes = {name.decode(): np.frombuffer(content, ">f4", -1, at).reshape(count, components)}
        assert kind == 0


message_type_to_class_constructor["POLYDATA"] = ReadPolyData


def until(what: Callable[[], Any]) -> Any:
    """What it returns once it is true."""
    end_s = time.monotonic() + WAIT_S
    while not (found := what()):
        assert time.monotonic() < end_s, "it never came true"
        time.sleep(0.02)
    return found


class Peer:
    """Slicer's place."""

    def __init__(self, port: int) -> None:
        self._client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)

    def newest(self, device: str) -> Any:
        """The next message of a device."""
        message = self._client.wait_for_message(device, WAIT_S)
        assert message is not None, device
        return message

    def picture(self, device: str = "IntrasplatPicture") -> NDArray[np.generic]:
        pixels: NDArray[np.generic] = self.newest(device).image[0]
        return pixels

    def until_status(self, *parts: str) -> str:
        """The first status that holds all of these."""
        end_s = time.monotonic() + WAIT_S
        while True:
            text: str = self.newest("IntrasplatStatus").string
            if all(part in text for part in parts):
                return text
            assert time.monotonic() < end_s, text

    def until_picture(self, wanted: NDArray[np.generic]) -> None:
        """Wait until this picture comes."""
        until(lambda: np.array_equal(self.picture(), wanted))

    def send_pose(self, matrix: NDArray[np.float64], device: str = "IntrasplatPose") -> None:
        self._client.send_message(pyigtl.TransformMessage(matrix, device_name=device))

    def send(self, command: str) -> None:
        self._client.send_message(pyigtl.StringMessage(command, device_name="IntrasplatCommand"))

    def leave(self) -> None:
        self._client.stop()


class Bridge:
    """`intrasplat slicer` as a process."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "client.cli", "slicer", *arguments]
        self._process = subprocess.Popen(
            command, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": "client"}
        )
        self._lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def said(self) -> str:
        return "".join(self._lines)

    @property
    def port(self) -> int:
        """Where it listens, once it does."""
        found: re.Match[str] = until(lambda: OPENED.search(self.said))
        return int(found[1])

    def end(self) -> int:
        """Its exit code after SIGTERM."""
        self._process.send_signal(signal.SIGTERM)
        return self.ended()

    def ended(self) -> int:
        """Its exit code, once it has ended."""
        code = self._process.wait(WAIT_S)
        self._reader.join()
        return code

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stderr is not None
        self._process.stderr.close()
        print(self.said)  # for whoever reads why a test failed

    def _read(self) -> None:
        assert self._process.stderr is not None
        self._lines.extend(iter(self._process.stderr.readline, ""))


@contextmanager
def bridge(*arguments: str) -> Iterator[Bridge]:
    running = Bridge(*arguments)
    try:
        yield running
    finally:
        running.close()


@contextmanager
def peer_of(running: Bridge) -> Iterator[Peer]:
    peer = Peer(running.port)
    try:
        yield peer
    finally:
        peer.leave()


def publish(site: Site) -> str:
    """A finished scene of moving tissue under a moving camera."""
    site.queued_job()
    claim = site.claim()
    folder = site.store.work_folder(claim.job_id, claim.attempt)
    scene = tissue()
    save_scene(folder, scene)
    times_s = tuple(scene.frame_times_s.tolist())
    about = {"warnings": (a_warning(DOUBT),), "frame_count": scene.frame_count, "frame_times_s": times_s}
    report = REPORT_OF_A_SCENE.model_copy(update=about)
    (folder / REPORT).write_text(report.model_dump_json())
    site.store.publish_scene(claim.job_id, claim.attempt)
    assert site.queue.finish(claim)
    site.announce()
    return claim.job_id


@contextmanager
def rendering_site(data_dir: Path) -> Iterator[Site]:
    """A service whose worker renders stored scenes, its kernels compiled."""
    render_frame(tissue(), 0.0)
    store = Store(data_dir)
    endpoint = f"ipc://{short_socket_path(store.run_dir, 'worker-1.sock')}"
    pace = Pace()
    with RequestServer(endpoint, Scheduler(Views(store).answer_in_parts, pace)):
        site, ended = Site(data_dir, endpoint, Painter(), pace), threading.Event()
        heart = threading.Thread(target=_beat, args=(site, ended))
        heart.start()
        try:
            yield site
        finally:
            ended.set()
            heart.join()
            site.stop()


def _beat(site: Site, ended: threading.Event) -> None:
    """Say again and again that the worker is there."""
    while not ended.wait(1.0):
        site.announce()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
    return port
