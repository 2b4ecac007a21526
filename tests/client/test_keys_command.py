"""`intrasplat keys`: what an operator types, and what the service then makes of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from client.cli import main
from contract.access.audit import AUDIT_FILE
from contract.access.keys import DAY_S, KeyFile, KeyScope
from contract.runtime.exits import ExitCode


def test_a_key_is_printed_once_and_alone_and_opens_what_it_was_made_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    lines = [json.loads(line) for line in (tmp_path / AUDIT_FILE).read_text().splitlines()]
    assert [(line["action"], line["key_id"], line["tenant"]) for line in lines] == [
        ("key-created", key_id, "ward-3"),
        ("key-revoked", key_id, "ward-3"),
    ]
    assert capsys.readouterr().out.strip().rpartition("_")[2] not in (tmp_path / AUDIT_FILE).read_text()


def test_a_key_that_cannot_be_recorded_is_not_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / AUDIT_FILE).mkdir()
    assert main(["keys", "create", "--tenant", "ward-3", "--data-dir", str(tmp_path)]) != ExitCode.OK
    assert capsys.readouterr().out == ""
    assert KeyFile(tmp_path).list() == ()


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
    assert (ending.expires_at_s or 0.0) + 80 * DAY_S < (new.expires_at_s or 0.0) < (old.expires_at_s or 0.0)
    main(["keys", "list", *where])
    assert all("  expires 20" in line for line in capsys.readouterr().out.splitlines())
    lines = [json.loads(line) for line in (tmp_path / AUDIT_FILE).read_text().splitlines()]
    assert [(line["action"], line["key_id"]) for line in lines[1:]] == [
        ("key-created", new.key_id),
        ("key-rotated", old.key_id),
    ]
    assert lines[-1]["outcome"].startswith(f"followed by {new.key_id}, ends 20")


@pytest.mark.parametrize("when", ["90", "2001-01-31", "0d", "soon", "-1d"])
def test_a_time_that_is_over_or_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], when: str
) -> None:
    create = ["keys", "create", "--tenant", "ward-3", f"--expires={when}", "--data-dir", str(tmp_path)]
    assert main(create) == ExitCode.BAD_INPUT
    assert "--expires" in capsys.readouterr().err
    assert KeyFile(tmp_path).list() == ()
