"""Labels, metadata and search from the client and from the command line."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from client.cli import main
from intrasplat.commands.exits import ExitCode
from intrasplat_client import Client, InputError, JobState, core
from tests.client.local_service import LocalService


@pytest.mark.parametrize("in_pieces", [False, True])
def test_a_job_is_labelled_found_and_labelled_anew(client: Client, clip: Path, in_pieces: bool) -> None:
    mark = f"find-{in_pieces}"
    job = client.reconstruct(clip, label=f"Ärger {mark}", metadata={"ris": mark}, in_pieces=in_pieces)
    client.reconstruct(clip)
    assert (job.label, job.metadata) == (f"Ärger {mark}", {"ris": mark})
    assert [each.id for each in client.jobs(q=f"ärger {mark}")] == [job.id]
    assert [each.id for each in client.jobs(JobState.QUEUED, metadata={"ris": mark}, preset="fast")] == [job.id]
    assert client.jobs(metadata={"ris": mark}, created_until_s=time.time() - 3600) == []
    assert client.scenes(q=mark) == []
    changed = client.label(job.id, metadata={"ris": mark, "room": "2"})
    assert (changed.label, changed.metadata) == (job.label, {"ris": mark, "room": "2"})
    emptied = client.label(job.id, "", {})
    assert (emptied.label, emptied.metadata) == (None, {})
    assert client.jobs(q=mark) == []


def test_a_label_that_cannot_be_is_refused_by_its_name(client: Client, clip: Path) -> None:
    with pytest.raises(InputError) as caught:
        client.reconstruct(clip, label="x" * 81)
    assert caught.value.field == "label"


def test_a_list_is_read_page_by_page_up_to_the_limit(
    client: Client, clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core, "MAX_PAGE", 2)
    ids = [client.reconstruct(clip, label="paged").id for _ in range(5)][::-1]
    assert [job.id for job in client.jobs(q="paged", limit=9)] == ids
    assert [job.id for job in client.jobs(q="paged", limit=3)] == ids[:3]
    assert [job.id for job in client.jobs(q="paged")] == ids[:2]


def test_the_command_line_labels_and_finds(
    service: LocalService, clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> str:
        assert main([*arguments, "--url", service.url]) == ExitCode.OK
        return capsys.readouterr().out.strip()

    job = run("submit", str(clip), "--label", "from a shell", "--metadata", "ris=S-1", "--metadata", "room=2")
    found = run("jobs", "--find", "SHELL", "--metadata", "ris=S-1", "--preset", "fast")
    assert found == f"{job}  queued     [from a shell]"
    assert run("jobs", "--find", "shell", "--until", "2020-01-01") == ""
    assert run("jobs", "--find", "shell", "--since", "2020-01-01T12:00").startswith(job)
    assert run("label", job, "--label", "other") == "other\nris=S-1\nroom=2"
    assert run("label", job, "--no-metadata") == "other"
    assert main(["label", job, "--url", service.url]) == ExitCode.BAD_INPUT
    for wrong in (["--metadata", "ris"], ["--since", "yesterday"]):
        with pytest.raises(SystemExit):
            main(["jobs", *wrong])
