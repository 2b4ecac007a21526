"""A service and workers that share no disk: queue, bucket and encrypted TCP alone lie between them."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from contract.queue.embedded import EmbeddedServer
from contract.runtime.settings import Settings
from intrasplat.view.render import render_frame
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video
from tests.archives import archived, files_of, small_scene

pytest.importorskip("s3fs")
moto_server: Any = pytest.importorskip("moto.server")
boto3: Any = pytest.importorskip("boto3")

PATIENCE_S = 120.0
ITERATIONS = 300
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def end_process(process: subprocess.Popen[bytes], timeout_s: float) -> None:
    """Ask the process to end, kill it after timeout_s, and wait for it."""
    process.terminate()
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def eventually(happens: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s
        time.sleep(0.1)


class Site:
    """A queue and a bucket, and what is started around them, each with a data directory of its own."""

    def __init__(self, folder: Path, ended: ExitStack) -> None:
        self.folder = folder
        self._ended = ended
        server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        ended.callback(server.stop)
        host, port = server.get_host_and_port()
        self._environment = {**os.environ, **KEYS, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}
        self.bucket = boto3.resource(
            "s3",
            endpoint_url=self._environment["AWS_ENDPOINT_URL"],
            aws_access_key_id=KEYS["AWS_ACCESS_KEY_ID"],
            aws_secret_access_key=KEYS["AWS_SECRET_ACCESS_KEY"],
            region_name=KEYS["AWS_DEFAULT_REGION"],
        ).Bucket("site")
        self.bucket.create()
        self._queue = EmbeddedServer(folder / "queue")
        self._queue.start()
        ended.callback(self._queue.stop)

    def machine(self, name: str, *command: str) -> subprocess.Popen[bytes]:
        settings = Settings(
            data_dir=self.folder / name,
            redis_url=self._queue.url,
            store_url="s3://site/clips",
            worker_name=name,
            device="cpu",
            port=self.port if name == "service" else 8765,
            render_endpoint=f"tcp://127.0.0.1:{free_port()}",
            render_secret="known to workers and services alone",
            min_free_bytes=0,
        )
        environment = self._environment | settings.to_environment()
        log = self._ended.enter_context((self.folder / f"{name}.log").open("wb"))
        process = subprocess.Popen([sys.executable, "-m", *command], env=environment, stdout=log, stderr=log)
        self._ended.callback(end_process, process, 30.0)
        return process

    def start_service(self) -> httpx.Client:
        self.port = free_port()
        self.machine("service", "service")
        http = self._ended.enter_context(httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=60.0))

        def answers() -> bool:
            try:
                return http.get("/healthz").is_success
            except httpx.TransportError:
                return False

        eventually(answers)
        return http

    def keys(self, area: str) -> list[str]:
        return [each.key for each in self.bucket.objects.filter(Prefix=f"clips/{area}/")]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as ended:
        yield Site(tmp_path, ended)


@contextmanager
def opened(folder: Path) -> Iterator[dict[str, Any]]:
    names = {"clip": "stereo.webm", "calibration": "calibration.json", "masks": "masks.zip"}
    with ExitStack() as closed:
        yield {part: closed.enter_context((folder / name).open("rb")) for part, name in names.items()}


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    write_stereo_video(make_phantom(PhantomSettings(width=96, height=80, frames=10)), tmp_path / "clip")
    return tmp_path / "clip"


def test_a_job_moves_from_machine_to_machine_and_its_purge_reaches_all(site: Site, clip: Path) -> None:
    http = site.start_service()
    first = site.machine("first", "worker", "consume")
    with opened(clip) as files:
        sent = http.post("/reconstruct", files=files, data={"options": f'{{"iterations": {ITERATIONS}}}'})
    assert sent.status_code == 202, sent.text
    job_id = sent.json()["id"]
    job = f"/jobs/{job_id}"

    eventually(lambda: bool(http.get(job).json()["iteration"]))
    end_process(first, 60.0)
    assert http.get(job).json()["state"] == "queued"
    assert len(site.keys("resume")) == 1

    site.machine("second", "worker", "consume")
    eventually(lambda: http.get(job).json()["state"] == "done")
    assert http.get(job).json()["attempt"] == 2
    eventually(lambda: site.keys("resume") == [])  # tidied up after the end is reported

    site.machine("third", "worker", "consume")
    eventually(lambda: len(http.get("/readyz").json()["workers"]) == 2)
    view = http.get("/render", params={"scene": job_id, "t": 0.5})
    assert view.status_code == 200, view.text
    assert http.get(f"/scenes/{job_id}").json()["iterations"] == ITERATIONS

    assert http.delete(f"/scenes/{job_id}").json()["verified"]
    assert http.get("/render", params={"scene": job_id, "t": 0.5}).status_code == 404
    assert [each.key for each in site.bucket.object_versions.all()] == []


def test_a_scene_imported_on_one_machine_is_shown_and_exported_on_others(site: Site, tmp_path: Path) -> None:
    scene = small_scene()
    archive = archived(tmp_path / "there", scene)
    http = site.start_service()
    first = site.machine("first", "worker", "consume")
    sent = http.post("/scenes", files={"scene": ("a.zip", archive)})
    assert sent.status_code == 202, sent.text
    job_id = sent.json()["id"]
    eventually(lambda: http.get(f"/jobs/{job_id}").json()["state"] == "done")
    end_process(first, 60.0)

    site.machine("second", "worker", "consume")
    eventually(lambda: http.get("/readyz").json().get("workers") == ["second"])
    asked = {"scene": job_id, "t": 0.5, "layer": "depth", "format": "npy"}
    eventually(lambda: http.get("/render", params=asked).status_code == 200)
    view = http.get("/render", params=asked)
    np.testing.assert_array_equal(np.load(io.BytesIO(view.content)), render_frame(scene, 0.5).depth_mm)
    exported = http.get(f"/scenes/{job_id}/export", params={"format": "scene"})
    assert files_of(exported.content)["scene.safetensors"] == files_of(archive)["scene.safetensors"]

    assert http.delete(f"/scenes/{job_id}").json()["verified"]
    assert [each.key for each in site.bucket.object_versions.all()] == []
