"""The command line against a real service: what it prints, what it exits with, what it says to do next."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import httpx
import pytest

import client as client_package
from client.cli import main
from client.connected import command_error
from client.remote import progress_of
from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobError
from intrasplat.commands.exits import ExitCode, exit_code_of
from intrasplat.errors import IntrasplatError
from intrasplat.names import MASKS, SUBMISSION
from intrasplat.report import Masks
from intrasplat_client import Client, JobState
from intrasplat_client.errors import error_of_document
from tests.archives import archived, small_scene
from tests.client.local_service import LocalService, local_service
from tests.reports import REPORT_OF_A_SCENE


def run_in(service: LocalService, *arguments: str) -> int:
    return main([*arguments, "--url", service.url])


def submitted(service: LocalService, clip: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert run_in(service, "submit", str(clip), *arguments) == ExitCode.OK
    return capsys.readouterr().out.strip()


def test_submit_watch_fetch_and_delete(
    service: LocalService, client: Client, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--iterations", "30", "--priority", "high", "--retention-hours", "12"]
    job_id = submitted(service, clip, capsys, *asked)
    options = client.job(job_id).options
    assert (options.iterations, options.priority, options.retention_hours) == (30, "high", 12.0)
    service.finish()
    assert run_in(service, "watch", job_id) == ExitCode.OK
    out = tmp_path / "results"
    assert run_in(service, "fetch", job_id, "--out", str(out), "--t", "0.5") == ExitCode.OK
    assert {path.name for path in out.iterdir()} == {"report.json", "curve.csv", "view.png", "scene.ply"}
    capsys.readouterr()
    assert run_in(service, "delete", job_id) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["job_id"] == job_id


def test_submit_uses_the_clip_of_an_earlier_job_with_other_masks(
    service: LocalService, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = submitted(service, clip, capsys)
    ZipFile(tmp_path / "better.zip", "w").close()
    assert run_in(service, "submit", "--clip-of", first, "--masks", str(tmp_path / "better.zip")) == ExitCode.OK
    folder = service.store.spool_folder(capsys.readouterr().out.strip())
    assert (folder / "clip.mp4").read_bytes() == clip.read_bytes()
    assert (folder / "masks.zip").read_bytes() == (tmp_path / "better.zip").read_bytes()


def test_fetch_saves_masks_that_were_found(
    service: LocalService, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job_id = submitted(service, clip, capsys)
    service.finish()
    masks = Masks(source="found", share=0.1, sure=0.9)
    service.store.add_scores("worker-1", job_id, 1, REPORT_OF_A_SCENE.model_copy(update={"masks": masks}))
    (service.store.scene_folder(job_id, 1) / MASKS).write_bytes(b"PK")
    assert run_in(service, "fetch", job_id, "--out", str(tmp_path), "--no-ply") == ExitCode.OK
    assert (tmp_path / MASKS).read_bytes() == b"PK"


def test_fetch_saves_the_stored_scene_if_asked(
    service: LocalService, client: Client, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job_id = submitted(service, clip, capsys)
    service.finish()
    service.store.add_scores("worker-1", job_id, 1, REPORT_OF_A_SCENE)
    assert run_in(service, "fetch", job_id, "--out", str(tmp_path), "--no-ply", "--scene") == ExitCode.OK
    stored = service.store.scene_folder(job_id, 1)
    assert {path.name: path.read_bytes() for path in (tmp_path / "scene").iterdir()} == {
        name: (stored / name).read_bytes() for name in ("manifest.json", "report.json", "curve.csv")
    }


def test_jobs_lists_cancel_stops_and_retry_queues_again(
    service: LocalService, client: Client, clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = submitted(service, clip, capsys)
    service.fail(JobError(problem="it diverged."))
    waiting = submitted(service, clip, capsys)
    assert run_in(service, "jobs", "--limit", "2") == ExitCode.OK
    assert capsys.readouterr().out.split() == [waiting, "queued", failed, "failed", "it", "diverged."]
    assert run_in(service, "jobs", "--state", "failed", "--limit", "1") == ExitCode.OK
    assert capsys.readouterr().out.startswith(failed)
    assert run_in(service, "retry", failed) == ExitCode.OK
    assert client.job(failed).state is JobState.QUEUED
    assert run_in(service, "cancel", waiting) == ExitCode.OK
    assert client.job(waiting).state is JobState.CANCELLED


def test_the_same_idempotency_key_prints_the_same_job(
    service: LocalService, clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    same = ["--idempotency-key", "monday 9:30"]
    assert submitted(service, clip, capsys, *same) == submitted(service, clip, capsys, *same)


def test_url_and_key_come_from_the_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, key = KeyFile(tmp_path).create("ward", {KeyScope.VIEW})
    with local_service(tmp_path, hosts=("ward.example",)) as service:
        monkeypatch.setenv("INTRASPLAT_URL", service.url)
        assert main(["jobs"]) == ExitCode.BAD_INPUT
        told = capsys.readouterr().err
        assert "--api-key" in told
        assert "Bearer" not in told
        monkeypatch.setenv("INTRASPLAT_API_KEY", key)
        assert main(["jobs"]) == ExitCode.OK


def test_a_command_that_waits_for_the_service_says_so_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[str] = []

    def sleep(seconds: float) -> None:
        told.append(capsys.readouterr().err)

    monkeypatch.setattr("intrasplat_client.connection.time.sleep", sleep)
    away = httpx.Response(503, json={"status": 503, "detail": "The queue does not answer.", "remedy": "Start it."})
    monkeypatch.setattr(httpx.HTTPTransport, "handle_request", lambda *_: away)
    assert main(["jobs"]) == ExitCode.UNAVAILABLE
    assert told[0] == "intrasplat: The queue does not answer. Asking again for up to 30 s.\n"
    assert set(told[1:]) == {""}


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["submit", "nothing.mp4"], ExitCode.BAD_INPUT),
        (["submit", "clip.mp4", "--holdout", "every9"], ExitCode.BAD_INPUT),
        (["submit", "--clip-of", "0" * 32], ExitCode.BAD_INPUT),
        (["watch", "0" * 32], ExitCode.BAD_INPUT),
        (["watch", "0" * 32, "--url", "http://127.0.0.1:9"], ExitCode.UNAVAILABLE),
        (["jobs", "--url", "http://127.0.0.1:none"], ExitCode.BAD_INPUT),
    ],
)
def test_exit_codes_tell_what_went_wrong(
    service: LocalService, arguments: list[str], code: ExitCode, capsys: pytest.CaptureFixture[str]
) -> None:
    url = [] if "--url" in arguments else ["--url", service.url]
    assert main([*arguments, *url]) == code
    assert capsys.readouterr().err.startswith("intrasplat: ")


@pytest.mark.parametrize("command", ["watch", "fetch", "cancel", "retry", "delete"])
def test_a_job_that_is_not_there_leads_to_the_list_of_those_that_are(
    service: LocalService, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", "never"] if command == "fetch" else []
    for job in ("nosuch", "0" * 32, "../jobs"):
        assert run_in(service, command, job, *out) == ExitCode.BAD_INPUT
        told = capsys.readouterr().err
        assert "GET" not in told
        assert "`intrasplat jobs` lists what there is" in told or "--help" in told
    assert not Path("never").exists()


def test_a_job_in_the_wrong_state_leads_to_the_command_that_helps(
    service: LocalService, clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job_id = submitted(service, clip, capsys)
    for command, remedy in (("fetch", f"intrasplat watch {job_id}"), ("delete", f"intrasplat cancel {job_id}")):
        assert (
            run_in(service, command, job_id, *(["--out", "never"] if command == "fetch" else [])) == ExitCode.BAD_INPUT
        )
        assert remedy in capsys.readouterr().err
    service.finish()
    assert run_in(service, "cancel", job_id) == ExitCode.BAD_INPUT
    assert f"intrasplat delete {job_id}" in capsys.readouterr().err


def test_a_job_whose_clip_is_gone_leads_to_submit(
    service: LocalService, clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job_id = submitted(service, clip, capsys)
    service.fail(JobError(problem="it diverged."))
    (service.store.spool_folder(job_id) / SUBMISSION).unlink()
    assert run_in(service, "retry", job_id) == ExitCode.BAD_INPUT
    assert "`intrasplat submit`" in capsys.readouterr().err


def refusal(status: int, **extensions: str) -> IntrasplatError:
    document = {"status": status, "detail": "It rains.", "field": "sky", "remedy": "GET /umbrella.", **extensions}
    return command_error(error_of_document(document))


def test_remedies_name_commands_where_one_helps_and_are_the_services_elsewhere() -> None:
    assert "`intrasplat watch abc`" in str(refusal(503, job_id="abc"))
    assert "`intrasplat delete JOB`" in str(refusal(507))
    assert "--api-key" in str(refusal(401))
    assert "`intrasplat jobs`" in str(refusal(404))
    for status in (403, 409, 422, 429, 500, 503):
        assert str(refusal(status)).endswith("It rains. GET /umbrella.")


@pytest.mark.parametrize(
    ("status", "code"),
    [(404, ExitCode.BAD_INPUT), (422, ExitCode.BAD_INPUT), (503, ExitCode.UNAVAILABLE), (500, ExitCode.FAILED)],
)
def test_an_answer_decides_the_exit_code(status: int, code: ExitCode) -> None:
    assert exit_code_of(refusal(status)) == code


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["unknown"],
        ["submit"],
        ["submit", "a", "--clip-of", "b"],
        ["submit", "a", "--budget-s", "1", "--iterations", "1"],
        ["submit", "a", "--retention-hours", "0"],
        ["fetch", "a", "--out", "b", "--t", "nan"],
        ["up", "--workers", "0"],
        ["jobs", "--state", "lost"],
    ],
)
def test_wrong_usage_ends_with_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == ExitCode.USAGE


@pytest.mark.parametrize("command", ["up", "submit", "watch", "fetch", "jobs", "cancel", "retry", "delete"])
def test_every_help_tells_the_exit_codes(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("INTRASPLAT_API_KEY", "isp_secret")
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    told = capsys.readouterr().out
    assert "exit codes" in told
    assert "isp_secret" not in told


@pytest.mark.parametrize("command", ["reconstruct", "render", "poses", "doctor", "worker"])
def test_local_commands_have_help_too(command: str) -> None:
    told = run_here(Path.cwd(), command, "--help").stdout
    assert told.startswith(f"usage: intrasplat {command} ")
    assert "exit codes" in told


def run_here(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, started in `folder`, whose `worker` is taken if it has one."""
    own = Path(client_package.__file__).parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(own.parent), str(own)))}
    command = [sys.executable, "-m", "client.cli", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_the_worker_is_one_process_that_ends_as_its_program_ends(tmp_path: Path) -> None:
    program = tmp_path / "worker" / "__main__.py"
    program.parent.mkdir()
    (program.parent / "__init__.py").touch()
    for source, status in (
        ("raise SystemExit(7)", 7),
        ("import os; os.kill(os.getpid(), 9)", -signal.SIGKILL),
        ("import os; os.kill(os.getpid(), 15)", -signal.SIGTERM),
    ):
        program.write_text(f"import sys; print(*sys.argv[1:], flush=True)\n{source}\n")
        ended = run_here(tmp_path, "worker", "a b", "--out", "c")
        assert ended.returncode == status
        assert ended.stdout == "consume a b --out c\n"


def test_a_job_that_has_not_begun_is_shown_by_its_state(client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    assert progress_of(job).stage == "queued"
    client.cancel(job.id)


def test_import_sends_a_scene_of_another_installation(
    service: LocalService, client: Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.zip"
    path.write_bytes(archived(tmp_path / "there", small_scene(50)))
    arguments = ["--label", "demo", "--metadata", "study=7", "--retention-hours", "5", "--idempotency-key", "once"]
    assert run_in(service, "import", str(path), *arguments) == ExitCode.OK
    job = client.job(capsys.readouterr().out.strip())
    assert (job.label, job.metadata, job.options.retention_hours, job.imported) == ("demo", {"study": "7"}, 5.0, True)
    assert (service.store.spool_folder(job.id) / "scene.zip").read_bytes() == path.read_bytes()
    assert (
        client.import_scene(path, label="demo", metadata={"study": "7"}, retention_hours=5, idempotency_key="once")
        == job
    )
    assert run_in(service, "import", str(tmp_path / "none.zip")) == ExitCode.BAD_INPUT
    path.write_bytes(b"no zip")
    assert run_in(service, "import", str(path)) == ExitCode.BAD_INPUT
    assert "scene: scene.zip is not a readable zip" in capsys.readouterr().err


def test_work_on_this_machine_without_torch_names_the_doctor(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "intrasplat.splat.backend", None)  # as in the service's container
    assert main(["render", str(tmp_path), "--t", "0", "--out", "view.png"]) == ExitCode.UNAVAILABLE
    assert "intrasplat doctor" in capsys.readouterr().err
