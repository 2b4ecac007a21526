"""The client against the real application: what the service says arrives as values or as the right exception."""

from __future__ import annotations

import asyncio
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
import uvicorn

import client as client_package
from client import Client, JobCancelled, JobFailed, JobRejected, RequestRefused, ServiceFault
from client.cli import main, progress_of
from contract.embedded import short_socket_path
from contract.errors import InputError, UnavailableError
from contract.exits import ExitCode
from contract.job import JobError, JobState
from contract.queue import Claim
from contract.queue_memory import MemoryQueue
from contract.rendering import MEDIA_TYPES, ExportRequest, RenderRequest, WorkerAddress
from contract.settings import Settings
from contract.store import CURVE, MANIFEST, REPORT, Store
from service.app import create_app
from service.renderer import ZmqRenderer
from worker.serve import RequestServer, View


def paint(request: RenderRequest | ExportRequest) -> View:
    """A 4 x 6 depth map that holds t everywhere."""
    if isinstance(request, ExportRequest):
        return View(b"ply\n", "application/octet-stream", request.t)
    buffer = io.BytesIO()
    np.save(buffer, np.full((4, 6), request.t, np.float32))
    return View(buffer.getvalue(), MEDIA_TYPES[request.format], request.t, ("seen from afar",))


class Town:
    """A service on a real port, and the queue and store behind it."""

    def __init__(self, data_dir: Path) -> None:
        self.queue, self.store = MemoryQueue(), Store(data_dir)
        settings = Settings(data_dir=data_dir, min_free_bytes=0)
        app = create_app(settings, self.queue, self.store, ZmqRenderer(self.queue, 5.0))
        self.server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
        self.thread = threading.Thread(target=lambda: asyncio.run(self.server.serve()))
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)
        self.url = f"http://127.0.0.1:{self.server.servers[0].sockets[0].getsockname()[1]}"

    def stop(self) -> None:
        self.server.should_exit = True
        self.thread.join()

    def claim(self) -> Claim:
        record = self.queue.claim("worker-1", 5.0)
        assert record is not None
        return Claim(record.job_id, record.attempt, "worker-1")

    def finish(self) -> None:
        claim = self.claim()
        folder = self.store.work_folder(claim.job_id, claim.attempt)
        (folder / MANIFEST).write_text("{}")
        (folder / REPORT).write_text('{"psnr_tissue_db": 36.2, "warnings": []}')
        (folder / CURVE).write_text("t_train_s,psnr_tissue_db\n1,30\n")
        self.store.publish_scene(claim.job_id, claim.attempt)
        self.queue.finish(claim)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Town]:
    town = Town(tmp_path_factory.mktemp("data"))
    endpoint = f"ipc://{short_socket_path(town.store.run_dir, 'worker-1.sock')}"
    with RequestServer(endpoint, paint):
        town.queue.announce(WorkerAddress(name="worker-1", endpoint=endpoint, device="cpu"))
        yield town
        town.stop()


@pytest.fixture
def client(town: Town) -> Iterator[Client]:
    town.queue.announce(town.queue.workers()[0])
    with Client(town.url) as client:
        yield client


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"frames")
    return path


def test_a_clip_becomes_a_scene_with_report_curve_export_and_renders(town: Town, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip, iterations=30)
    assert job.state is JobState.QUEUED
    assert job.options.iterations == 30
    town.finish()
    assert client.wait(job.id).state is JobState.DONE
    assert client.report(job.id)["psnr_tissue_db"] == 36.2
    assert client.curve(job.id).startswith("t_train_s")
    assert client.export(job.id) == b"ply\n"
    image = client.render(t=0.5, scene=job.id, layer="depth", format="npy", width=64)
    np.testing.assert_array_equal(image.array(), np.full((4, 6), 0.5, np.float32))
    assert (image.scene, image.t, image.warning) == (job.id, 0.5, "seen from afar")
    client.delete(job.id)
    with pytest.raises(RequestRefused) as caught:
        client.report(job.id)
    assert caught.value.status == 404


def test_watching_shows_each_state_and_ends_with_the_last(town: Town, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    states = []
    for view in client.watch(job.id, poll_s=0.01):
        states.append(view.state)
        if view.state is JobState.QUEUED:
            client.cancel(job.id)
    assert states == [JobState.QUEUED, JobState.CANCELLED]
    with pytest.raises(JobCancelled):
        client.wait(job.id)


def test_a_job_that_failed_by_its_input_differs_from_one_that_failed_otherwise(
    town: Town, client: Client, clip: Path
) -> None:
    rejected, broken = client.reconstruct(clip), client.reconstruct(clip)
    town.queue.fail(town.claim(), JobError(problem="one eye only.", field="clip", remedy="Send both."))
    town.queue.fail(town.claim(), JobError(problem="it diverged."))
    with pytest.raises(JobRejected, match="Send both"):
        client.wait(rejected.id)
    with pytest.raises(JobFailed, match="diverged"):
        client.wait(broken.id)


def test_a_refused_request_names_field_and_remedy(client: Client, tmp_path: Path) -> None:
    odd = tmp_path / "clip.exe"
    odd.write_bytes(b"x")
    with pytest.raises(RequestRefused) as caught:
        client.reconstruct(odd)
    assert (caught.value.status, caught.value.field) == (422, "clip")
    assert ".mp4" in caught.value.remedy


def test_a_file_that_is_not_there_is_a_bad_input(client: Client, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.mp4"):
        client.reconstruct(tmp_path / "nothing.mp4")


def test_no_service_is_unavailable_and_not_ready() -> None:
    with Client("http://127.0.0.1:9") as client:
        assert not client.is_ready()
        with pytest.raises(UnavailableError, match="intrasplat up"):
            client.jobs()


def test_an_answer_that_is_no_problem_document_is_a_fault_of_the_service() -> None:
    transport = httpx.MockTransport(lambda request: httpx.Response(502, text="<html>proxy</html>"))
    with Client(transport=transport) as client, pytest.raises(ServiceFault, match="502"):
        client.jobs()


def test_submit_watch_and_fetch_on_the_command_line(
    town: Town, client: Client, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["submit", str(clip), "--iterations", "30", "--url", town.url]) == ExitCode.OK
    job_id = capsys.readouterr().out.strip()
    assert client.job(job_id).options.iterations == 30
    town.finish()
    assert main(["watch", job_id, "--url", town.url]) == ExitCode.OK
    out = tmp_path / "results"
    assert main(["fetch", job_id, "--out", str(out), "--t", "0.5", "--url", town.url]) == ExitCode.OK
    assert {path.name for path in out.iterdir()} == {"report.json", "curve.csv", "view.png", "scene.ply"}


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["submit", "nothing.mp4"], ExitCode.BAD_INPUT),
        (["submit", "clip.mp4", "--holdout", "every9"], ExitCode.BAD_INPUT),
        (["watch", "0" * 32], ExitCode.BAD_INPUT),
        (["watch", "0" * 32, "--url", "http://127.0.0.1:9"], ExitCode.UNAVAILABLE),
    ],
)
def test_exit_codes_tell_what_went_wrong(
    town: Town, arguments: list[str], code: ExitCode, capsys: pytest.CaptureFixture[str]
) -> None:
    url = [] if "--url" in arguments else ["--url", town.url]
    assert main([*arguments, *url]) == code
    assert capsys.readouterr().err.startswith("intrasplat: ")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["unknown"],
        ["submit"],
        ["submit", "a", "--budget-s", "1", "--iterations", "1"],
        ["fetch", "a", "--out", "b", "--t", "nan"],
    ],
)
def test_wrong_usage_ends_with_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == ExitCode.USAGE


@pytest.mark.parametrize("command", ["up", "submit", "watch", "fetch"])
def test_every_help_tells_the_exit_codes(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    assert "exit codes" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["reconstruct", "render", "phantom", "doctor"])
def test_local_commands_have_help_too(command: str) -> None:
    assert "exit codes" in run_here(Path.cwd(), command, "--help").stdout


def run_here(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, started in `folder`, whose `worker` is taken if it has one."""
    environment = os.environ | {"PYTHONPATH": str(Path(client_package.__file__).parents[1])}
    command = [sys.executable, "-m", "client.cli", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_a_local_command_is_one_process_that_ends_as_the_workers_program_ends(tmp_path: Path) -> None:
    program = tmp_path / "worker" / "__main__.py"
    program.parent.mkdir()
    (program.parent / "__init__.py").touch()
    for source, status in (
        ("raise SystemExit(7)", 7),
        ("import os; os.kill(os.getpid(), 9)", -signal.SIGKILL),
        ("import os; os.kill(os.getpid(), 15)", -signal.SIGTERM),
    ):
        program.write_text(f"import sys; print(*sys.argv[1:], flush=True)\n{source}\n")
        ended = run_here(tmp_path, "reconstruct", "a b", "--out", "c")
        assert ended.returncode == status
        assert ended.stdout == "reconstruct a b --out c\n"


def test_a_job_that_has_not_begun_is_shown_by_its_state(client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    assert progress_of(job).stage == "queued"
    client.cancel(job.id)
