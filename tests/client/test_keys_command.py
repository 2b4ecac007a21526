"""`intrasplat keys`: what an operator types, and what the service then makes of it."""

from __future__ import annotations

import json
import multiprocessing
import os
from pathlib import Path

import pytest

from client.cli import main
from contract.access.audit import AUDIT_FILE, utc_text
from contract.access.keys import DAY_S, KEYS_FILE, KeyFile, KeyScope
from intrasplat.commands.exits import ExitCode
from intrasplat.files.durable import temporary_path
from tests.contract.stores import SERVICE, given_to


def lines(folder: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in (folder / AUDIT_FILE).read_text().splitlines()]


def acts(folder: Path) -> list[tuple[str, str, str]]:
    return [(line["action"], line["key_id"], line["outcome"]) for line in lines(folder)]


def test_a_key_is_printed_once_and_alone_and_opens_what_it_was_made_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tmp_path /= "not/yet/there"
    where = ["--data-dir", str(tmp_path)]
    create = ["keys", "create", "--tenant", "ward-3", "--scopes", "view,operate", "--label", "theatre 2"]
    assert main([*create, *where]) == ExitCode.OK
    text = capsys.readouterr().out.strip()
    key = KeyFile(tmp_path).find(text)
    assert key is not None
    assert (key.tenant, key.scopes) == ("ward-3", frozenset({KeyScope.VIEW, KeyScope.OPERATE}))
    assert main(["keys", "list", *where]) == ExitCode.OK
    listed = capsys.readouterr().out
    assert listed.split()[:3] == [key.key_id, "ward-3", "operate,view"]
    assert "theatre 2" in listed
    assert text.rpartition("_")[2] not in listed
    assert main(["keys", "revoke", key.key_id, *where]) == ExitCode.OK
    assert KeyFile(tmp_path).find(text) is None


def test_keys_that_come_and_go_are_in_the_audit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--data-dir", str(tmp_path)]
    main(["keys", "create", "--tenant", "ward-3", *where])
    key_id = KeyFile(tmp_path).list()[0].key_id
    main(["keys", "revoke", key_id, *where])
    assert [line["tenant"] for line in lines(tmp_path)] == ["ward-3"] * 4
    assert acts(tmp_path) == [
        ("key-created", key_id, "begun"),
        ("key-created", key_id, "done"),
        ("key-revoked", key_id, "begun"),
        ("key-revoked", key_id, "done"),
    ]
    assert capsys.readouterr().out.strip().rpartition("_")[2] not in (tmp_path / AUDIT_FILE).read_text()


def test_a_key_that_cannot_be_recorded_is_not_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / AUDIT_FILE).mkdir()
    assert main(["keys", "create", "--tenant", "ward-3", "--data-dir", str(tmp_path)]) != ExitCode.OK
    assert capsys.readouterr().out == ""
    assert KeyFile(tmp_path).list() == ()


CHANGES = [["create", "--tenant", "ward-4"], ["rotate", "ID"], ["revoke", "ID"]]


def change(folder: Path, arguments: list[str]) -> int:
    """Run that command on a folder with one key."""
    (key,) = KeyFile(folder).list()
    return main(["keys", *(key.key_id if word == "ID" else word for word in arguments), "--data-dir", str(folder)])


@pytest.mark.parametrize("arguments", CHANGES)
def test_of_a_change_that_fails_the_audit_says_that_it_was_begun_and_not_that_it_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    before, _ = KeyFile(tmp_path).create("ward-3")
    temporary_path(tmp_path / KEYS_FILE).mkdir()  # the new file cannot be written
    assert change(tmp_path, arguments) == ExitCode.UNAVAILABLE
    told = capsys.readouterr()
    assert (told.out, told.err[:12]) == ("", "intrasplat: ")
    assert KeyFile(tmp_path).list() == (before,)
    assert {outcome.split()[0] for _, _, outcome in acts(tmp_path)} == {"begun"}


def change_and_be_killed(folder: Path, arguments: list[str], after_it: bool) -> None:
    rename = Path.rename

    def rename_and_die(source: Path, target: Path) -> Path:
        if after_it or target.name != KEYS_FILE:
            rename(source, target)
        if target.name == KEYS_FILE:
            os._exit(9)
        return target

    Path.rename = rename_and_die  # type: ignore[assignment, method-assign]
    change(folder, arguments)


@pytest.mark.parametrize("after_it", [False, True])
@pytest.mark.parametrize("arguments", CHANGES)
def test_of_a_change_that_was_killed_the_audit_says_that_it_was_begun_and_it_is_all_there_or_not_at_all(
    tmp_path: Path, arguments: list[str], after_it: bool
) -> None:
    before, _ = KeyFile(tmp_path).create("ward-3")
    kill = multiprocessing.get_context("spawn").Process(
        target=change_and_be_killed, args=(tmp_path, arguments, after_it)
    )
    kill.start()
    kill.join()
    assert kill.exitcode == 9
    told = acts(tmp_path)
    assert {outcome.split()[0] for _, _, outcome in told} == {"begun"}
    keys = KeyFile(tmp_path).list()
    if not after_it:
        assert keys == (before,)
    else:
        changed = {(each.key_id, each.expires_at_s is not None) for each in keys} ^ {(before.key_id, False)}
        assert {key_id for key_id, _ in changed} == {key_id for _, key_id, _ in told}
    assert main(["keys", "create", "--tenant", "ward-5", "--data-dir", str(tmp_path)]) == ExitCode.OK


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a folder to another user")
@pytest.mark.parametrize("arguments", CHANGES)
def test_root_is_refused_where_its_files_would_shut_out_the_service_and_leaves_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    KeyFile(tmp_path).create("ward-3")
    given_to(SERVICE, tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert change(tmp_path, arguments) == ExitCode.UNAVAILABLE
    assert f"belongs to another user (uid {SERVICE}). Run the command as that user" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
    assert main(["keys", "list", "--data-dir", str(tmp_path)]) == ExitCode.OK


@pytest.mark.parametrize(
    "arguments",
    [
        ["create", "--tenant", "Ward 3"],
        ["create", "--tenant", "ward-3", "--scopes", "everything"],
        ["create", "--tenant", "ward-3", "--label", "x" * 61],
        ["revoke", "000000000000"],
    ],
)
def test_bad_arguments_are_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    assert main(["keys", *arguments, "--data-dir", str(tmp_path)]) == ExitCode.BAD_INPUT
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("intrasplat: ")


def test_a_key_is_made_to_expire_and_rotated_and_the_list_and_the_audit_tell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--data-dir", str(tmp_path)]
    assert main(["keys", "create", "--tenant", "ward-3", "--expires", "2090-01-31", *where]) == ExitCode.OK
    old_text = capsys.readouterr().out.strip()
    (old,) = KeyFile(tmp_path).list()
    assert main(["keys", "rotate", old.key_id, "--overlap", "12h", "--expires", "90d", *where]) == ExitCode.OK
    text = capsys.readouterr().out.strip()
    ending, new = KeyFile(tmp_path).find(old_text), KeyFile(tmp_path).find(text)
    assert ending is not None
    assert new is not None
    ends, expires = (key.expires_at_s or 0.0 for key in (ending, new))
    assert ends + 80 * DAY_S < expires < (old.expires_at_s or 0.0)
    main(["keys", "list", *where])
    assert all("  expires 20" in line for line in capsys.readouterr().out.splitlines())
    how = f" (followed by {new.key_id}, ends {utc_text(ends)})"
    assert acts(tmp_path)[2:] == [
        (action, key_id, f"{state}{more}")
        for state in ("begun", "done")
        for action, key_id, more in (("key-created", new.key_id, ""), ("key-rotated", old.key_id, how))
    ]


@pytest.mark.parametrize("when", ["90", "2001-01-31", "0d", "soon", "-1d"])
def test_a_time_that_is_over_or_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], when: str
) -> None:
    create = ["keys", "create", "--tenant", "ward-3", f"--expires={when}", "--data-dir", str(tmp_path)]
    assert main(create) == ExitCode.BAD_INPUT
    assert "--expires" in capsys.readouterr().err
    assert KeyFile(tmp_path).list() == ()
