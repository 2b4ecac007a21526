"""`intrasplat backup` and `restore`: what an operator types, with the queue that the data directory has of its own."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from client.cli import main
from contract.queue.installed import installed_queue
from contract.runtime.settings import Settings
from contract.store.owner import check_owner
from contract.store.store import Store
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import UnavailableError
from tests.contract.stores import SERVICE, accepted, given_to


@pytest.fixture(autouse=True)
def no_queue_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("REDIS_URL", raising=False)


def test_a_service_that_does_not_run_is_backed_up_and_restored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, shelf = (tmp_path / name for name in ("old", "new", "backups"))
    record = accepted(Store(old))
    with installed_queue(Settings(data_dir=old)) as queue:
        queue.submit(record)
    assert main(["backup", str(shelf), "--data-dir", str(old)]) == ExitCode.OK
    told = capsys.readouterr()
    backup = Path(told.out.strip())
    assert backup.parent == shelf
    assert "1 jobs (1 queued)" in told.err
    assert main(["restore", str(backup), "--data-dir", str(new)]) == ExitCode.OK
    assert "every hash compared: 1 jobs (1 queued)" in capsys.readouterr().err
    with installed_queue(Settings(data_dir=new)) as queue:
        assert [each.job_id for each in queue.records()] == [record.job_id]
    assert main(["restore", str(backup), "--data-dir", str(new)]) == ExitCode.UNAVAILABLE
    assert "is not empty" in capsys.readouterr().err


@pytest.mark.parametrize(("folder", "told"), [("absent", "no data directory"), ("old", "REDIS_URL: ")])
def test_a_folder_that_cannot_be_the_services_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: str, told: str
) -> None:
    Store(tmp_path / "old")
    backup = ["backup", str(tmp_path / "backups"), "--data-dir", str(tmp_path / folder)]
    assert main(backup) == ExitCode.BAD_INPUT
    assert told in capsys.readouterr().err
    assert not (tmp_path / "backups").exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a folder to another user")
@pytest.mark.parametrize("command", ["backup", "restore"])
def test_root_is_refused_where_its_files_would_shut_out_the_service_and_leaves_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    Store(tmp_path / "old")
    given_to(SERVICE, tmp_path / "old")
    before = sorted((tmp_path / "old").rglob("*"))
    assert main([command, str(tmp_path / "backups"), "--data-dir", str(tmp_path / "old")]) == ExitCode.UNAVAILABLE
    assert f"belongs to another user (uid {SERVICE}). Run the command as that user" in capsys.readouterr().err
    assert sorted((tmp_path / "old").rglob("*")) == before


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a folder to another user")
def test_a_volume_of_roots_whose_group_the_service_is_in_is_the_services(tmp_path: Path) -> None:
    """As in Kubernetes: root may not write where the service has, the service may."""
    check_owner(tmp_path)
    (tmp_path / "spool").mkdir()
    check_owner(tmp_path)
    given_to(SERVICE, tmp_path / "spool")
    with pytest.raises(UnavailableError, match="another user"):
        check_owner(tmp_path)
    check_owner(tmp_path / "absent")
