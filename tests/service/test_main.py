"""When `python -m service` refuses to start, and what it says then."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.access.keys import KeyFile, KeyScope
from intrasplat.commands.exits import ExitCode
from service.__main__ import main
from service.server import Server
from tests.contract.queues import RunningServer, valkey_binary


@pytest.fixture(autouse=True)
def _environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("INTRASPLAT_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("REDIS_URL", f"unix://{tmp_path}/nobody.sock")
    monkeypatch.setattr("service.__main__.configure", lambda *_: None)


def test_a_host_that_others_can_reach_is_not_served_without_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("INTRASPLAT_HOST", "0.0.0.0")
    assert main() == ExitCode.UNAVAILABLE
    assert "intrasplat keys create" in capsys.readouterr().err
    served: list[Server] = []
    monkeypatch.setattr(Server, "run", lambda server: served.append(server))
    KeyFile(tmp_path).create("clinic", frozenset(KeyScope))
    main()
    assert len(served) == 1


def test_a_queue_that_is_away_is_not_waited_for_but_a_wrong_password_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    served: list[Server] = []
    monkeypatch.setattr(Server, "run", lambda server: served.append(server))
    main()
    assert len(served) == 1
    server = RunningServer(valkey_binary(), tmp_path / "queue", requirepass="secret")
    monkeypatch.setenv("REDIS_URL", f"unix://:wrong@{server.socket}")
    assert main() == ExitCode.UNAVAILABLE
    assert "REDIS_URL" in capsys.readouterr().err
    assert len(served) == 1
    server.stop()


@pytest.mark.parametrize(
    ("variable", "value", "code"),
    [
        ("REDIS_URL", "", ExitCode.UNAVAILABLE),
        ("INTRASPLAT_PORT", "many", ExitCode.BAD_INPUT),
    ],
)
def test_what_is_missing_or_wrong_in_the_environment_is_named(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    variable: str,
    value: str,
    code: ExitCode,
) -> None:
    monkeypatch.setenv(variable, value)
    assert main() == code
    assert variable in capsys.readouterr().err
