"""The containers keep to their rules, as far as that can be read; the queue's access list holds on a real server."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import redis
import yaml  # type: ignore[import-untyped]

from contract.queue.embedded import find_server
from contract.queue.interface import Claim, Order
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.wire.job import JobFiles, JobProgress, JobRecord, JobState
from contract.wire.rendering import WorkerAddress
from tests.test_layers import imports_of
from tests.test_repository import project, requirement_name

DOCKER = Path(__file__).resolve().parent.parent / "docker"
REPOSITORY = DOCKER.parent
DOCKERFILES = sorted(DOCKER.glob("*.Dockerfile"))
TRACED = DOCKER / "compose.traces.yml"
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
PINNED = re.compile(r"[a-z/-]+:\d+\.\d+\.\d+[a-z0-9.-]*(@sha256:[0-9a-f]{64})?$")
START_TIMEOUT_S = 20.0
PROXY_VARIABLES = frozenset({"INTRASPLAT_HOSTS", "FORWARDED_ALLOW_IPS"})
NOT_IN_IMAGES = frozenset({"charts", "dev", "gpu", "slicer"})
"""Extras that no container of a CPU needs: of charts, of tests, of GPUs, and of a bridge that runs beside Slicer."""

each_service = pytest.mark.parametrize("name", SERVICES)
each_dockerfile = pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)


def instructions(path: Path) -> list[tuple[str, str]]:
    """The instructions of a Dockerfile with their arguments, continued lines joined, comments left out."""
    lines = "\n".join(line for line in path.read_text().splitlines() if not line.lstrip().startswith("#"))
    joined = re.sub(r"\\\n\s*", " ", lines)
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in joined.splitlines() if line.strip()]


def last_stage(path: Path) -> list[tuple[str, str]]:
    found = instructions(path)
    return found[max(n for n, (name, _) in enumerate(found) if name == "FROM") :]


@each_service
def test_a_container_can_change_nothing_but_its_volumes_and_gain_no_rights(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not {"privileged", "cap_add", "devices", "pid", "ipc", "network_mode"} & service.keys()
    assert not any(volume.startswith(("/", ".")) for volume in service["volumes"])  # none of the host's folders


@each_service
def test_a_container_has_limits_a_time_to_end_and_a_network_of_ours(name: str) -> None:
    service = SERVICES[name]
    for key in ("mem_limit", "pids_limit", "stop_grace_period", "restart"):
        assert service[key]
    assert set(service["networks"]) <= set(COMPOSE["networks"])
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert ("outside" in service["networks"]) == (name == "service")


@each_service
def test_a_container_runs_as_a_user_without_rights(name: str) -> None:
    service = SERVICES[name]
    user = service.get("user") or [text for kind, text in last_stage(dockerfile_of(service)) if kind == "USER"][-1]
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)


@each_service
def test_a_container_says_whether_it_is_well(name: str) -> None:
    service = SERVICES[name]
    assert "healthcheck" in service or "HEALTHCHECK" in [kind for kind, _ in last_stage(dockerfile_of(service))]


@each_service
def test_images_have_full_versions(name: str) -> None:
    service = SERVICES[name]
    assert PINNED.match(service["image"])
    if "build" in service:
        assert service["image"].endswith(f":{project()['version']}")


@each_service
def test_no_secret_stands_in_the_environment(name: str) -> None:
    for variable, value in SERVICES[name].get("environment", {}).items():
        if variable not in PROXY_VARIABLES:
            assert variable.endswith("_FILE")
            assert value.removeprefix("/run/secrets/") in SERVICES[name]["secrets"]


def test_a_proxy_is_named_from_outside_the_file() -> None:
    environment = SERVICES["service"]["environment"]
    assert {name: environment[name] for name in PROXY_VARIABLES} == {
        "INTRASPLAT_HOSTS": "${INTRASPLAT_HOSTS:-}",
        "FORWARDED_ALLOW_IPS": "${FORWARDED_ALLOW_IPS:-127.0.0.1}",
    }


def test_traces_leave_by_a_collector_so_that_the_worker_still_has_no_way_out() -> None:
    traced = yaml.safe_load(TRACED.read_text())
    collector = traced["services"].pop("collector")
    assert traced["services"].keys() == {"service", "worker"}
    config = yaml.safe_load((DOCKER / traced["configs"]["collector"]["file"]).read_text())
    port = config["receivers"]["otlp"]["protocols"]["http"]["endpoint"].rpartition(":")[2]
    endpoint = {"OTEL_EXPORTER_OTLP_ENDPOINT": f"http://collector:{port}"}
    for changes in traced["services"].values():
        assert changes == {"environment": endpoint}  # and so no other network than in compose.yml
    assert set(collector["networks"]) == COMPOSE["networks"].keys() == {"inside", "outside"}
    assert not {"ports", "volumes", "privileged", "cap_add", "devices", "pid", "ipc", "network_mode"} & collector.keys()
    for key in ("read_only", "cap_drop", "security_opt", "restart", "logging"):
        assert collector[key] == SERVICES["worker"][key]
    assert all(collector[key] for key in ("mem_limit", "pids_limit", "stop_grace_period"))
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", collector["user"])
    assert PINNED.match(collector["image"])
    (mounted,) = collector["configs"]
    assert collector["command"] == [f"--config={mounted['target']}"]
    assert config["service"]["pipelines"].keys() == {"traces"}
    assert config["exporters"]["otlphttp"]["endpoint"] == "${env:TRACES_TO}"
    assert collector["environment"].keys() == {"TRACES_TO"}


@each_service
def test_logs_go_to_a_driver_that_docker_and_podman_have(name: str) -> None:
    assert SERVICES[name]["logging"]["driver"] == "json-file"


def test_only_the_service_is_published_and_only_to_its_own_machine() -> None:
    ports = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert list(ports) == ["service"]
    assert all(port.startswith("127.0.0.1:") for port in ports["service"])


def test_the_queue_puts_every_write_on_disk_and_drops_nothing() -> None:
    command = SERVICES["queue"]["command"]
    options = dict(zip(command[1::2], command[2::2], strict=True))
    assert options["--appendonly"] == "yes"
    assert options["--appendfsync"] == "always"
    assert options["--maxmemory-policy"] == "noeviction"


@each_dockerfile
def test_a_dockerfile_starts_from_a_full_version_and_fetches_nothing_unseen(path: Path) -> None:
    found = instructions(path)
    bases = dict(text.split("=", 1) for kind, text in found if kind == "ARG" and text.startswith("BASE="))
    for kind, text in found:
        if kind == "FROM":
            assert PINNED.match(text.split()[0].replace("${BASE}", bases["BASE"]))
        assert kind != "ADD"
        assert not re.search(r"curl|wget|:latest|sudo", text)


@each_dockerfile
def test_a_dockerfile_copies_only_what_is_there_and_let_through(path: Path) -> None:
    let_through = {line[1:] for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if line[:1] == "!"}
    sources = [
        source
        for kind, text in instructions(path)
        if kind == "COPY" and "--from" not in text
        for source in text.split()[:-1]
    ]
    assert [source for source in sources if not (REPOSITORY / source).exists()] == []
    assert [source for source in sources if not {source, source.split("/")[0]} & let_through] == []


def test_the_service_image_has_every_package_that_the_service_imports() -> None:
    text = next(text for kind, text in instructions(DOCKER / "service.Dockerfile") if " fastapi " in text)
    installed = {requirement_name(word) for word in text.split()}
    providers = packages_distributions()
    modules = {each.module.split(".")[0] for package in ("contract", "service") for each in imports_of(package)}
    own = {"intrasplat", "contract", "service", "client"}
    foreign = modules - sys.stdlib_module_names - own - {"pydantic_core"}  # a part of pydantic, which brings it
    names = {module: {each.lower().replace("_", "-") for each in providers[module]} for module in foreign}
    assert [module for module in sorted(foreign) if not names[module] & installed] == []


def test_the_worker_image_has_every_extra_that_a_worker_can_use() -> None:
    extras = {name for folder in (".", "service") for name in project(folder)["optional-dependencies"]} - NOT_IN_IMAGES
    (default,) = (text for kind, text in instructions(DOCKER / "worker.Dockerfile") if text.startswith("EXTRAS="))
    assert set(default.removeprefix("EXTRAS=").split(",")) == extras
    gpu = yaml.safe_load((DOCKER / "compose.gpu.yml").read_text())["services"]["worker"]["build"]["args"]["EXTRAS"]
    assert set(gpu.split(",")) == extras | {"gpu"}


@each_dockerfile
def test_the_command_line_is_in_every_image(path: Path) -> None:
    copied = {source for kind, text in instructions(path) if kind == "COPY" for source in text.split()[:-1]}
    assert {"intrasplat", "contract", "client"} <= copied
    assert copied & {"service", "service/pyproject.toml"}  # which registers the server's commands


def test_docker_itself_finds_no_fault_with_the_files() -> None:
    checked = [
        ["docker", "compose", "--file", str(DOCKER / "compose.yml"), "config", "--quiet"],
        ["docker", "compose", "--file", str(DOCKER / "compose.yml"), "--file", str(TRACED), "config", "--quiet"],
        *(["hadolint", "--failure-threshold", "error", str(path)] for path in DOCKERFILES),
    ]
    able = [command for command in checked if _is_there(command)]
    if not able:
        pytest.skip("neither docker compose nor hadolint is here")
    for command in able:
        subprocess.run(
            command, check=True, timeout=60, env={**os.environ, "TRACES_TO": "http://collector.example.org:4318"}
        )


def _is_there(command: list[str]) -> bool:
    probe = [*command[:2], "version"] if command[0] == "docker" else [command[0], "--version"]
    return shutil.which(command[0]) is not None and subprocess.run(probe, capture_output=True).returncode == 0


def dockerfile_of(service: dict[str, Any]) -> Path:
    return REPOSITORY / str(service["build"]["dockerfile"])


@pytest.fixture(scope="module")
def secret_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address, with its password, of a server started with the compose file's command and made secrets."""
    folder = tmp_path_factory.mktemp("queue")
    subprocess.run([DOCKER / "make-secrets.sh", folder / "secrets"], check=True, capture_output=True)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    acl = {"/run/secrets/queue_acl": str(folder / "secrets" / "queue.acl")}
    options = [acl.get(word, word) for word in SERVICES["queue"]["command"][1:]]
    command = [str(find_server().path), *options, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
        try:
            deadline_s = time.monotonic() + START_TIMEOUT_S
            while not _listens(port):
                assert server.poll() is None
                assert time.monotonic() < deadline_s
                time.sleep(0.02)
            url = (folder / "secrets" / "redis_url").read_text().strip()
            yield url.replace("@queue:6379", f"@127.0.0.1:{port}")
        finally:
            server.terminate()


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_the_access_list_lets_the_queue_do_all_it_does(secret_url: str) -> None:
    queue = RedisQueue(secret_url)
    jobs = [JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=time.time()) for _ in "abc"]
    for job in jobs:
        assert queue.submit(job).job_id == job.job_id
    queue.forecast(jobs[1].job_id)
    for end in (queue.finish, queue.release):
        record = queue.claim("worker-1", 1.0)
        assert record is not None
        claim = Claim(record.job_id, record.attempt, "worker-1")
        assert queue.beat(claim, JobProgress(stage="train", fraction=0.5)) is Order.GO_ON
        assert end(claim)
    cancelled = queue.cancel(jobs[2].job_id)
    assert cancelled is not None
    assert cancelled.state is JobState.CANCELLED
    assert queue.events(jobs[0].job_id)
    assert queue.forget(jobs[0].job_id)
    queue.announce(WorkerAddress(name="worker-1", endpoint="ipc://socket", device="cpu"))
    assert [worker.name for worker in queue.workers()] == ["worker-1"]
    queue.withdraw("worker-1")
    assert len(queue.records()) == 2
    assert queue.figures().queued == 1
    assert queue.rewrite_log()
    queue.close()


def test_the_access_list_lets_nobody_do_anything_else(secret_url: str) -> None:
    with redis.Redis.from_url(secret_url) as ours:
        for command in (["SET", "other", "1"], ["CONFIG", "GET", "*"], ["FLUSHALL"], ["KEYS", "*"], ["ACL", "LIST"]):
            with pytest.raises(redis.exceptions.NoPermissionError):
                ours.execute_command(*command)
    stranger_url = re.sub(r"//.*@", "//", secret_url)
    with redis.Redis.from_url(stranger_url) as stranger:
        assert stranger.ping()  # what the container's health check does
        for command in (["GET", "{intrasplat}:jobs"], ["INFO"], ["EVAL", "return 1", "0"]):
            with pytest.raises(redis.exceptions.NoPermissionError):
                stranger.execute_command(*command)


def test_secrets_that_are_there_stay(tmp_path: Path) -> None:
    made = []
    for _ in range(2):
        subprocess.run([DOCKER / "make-secrets.sh", tmp_path / "secrets"], check=True, capture_output=True)
        made.append({path.name: path.read_text() for path in (tmp_path / "secrets").iterdir()})
    assert set(made[0]) == {"queue.acl", "redis_url"}
    assert made[0] == made[1]


@pytest.fixture
def health() -> ModuleType:
    spec = importlib.util.spec_from_file_location("health", DOCKER / "health.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_worker_is_well_while_it_is_announced(health: ModuleType, secret_url: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, redis_url=secret_url, worker_name="worker-7")
    queue = RedisQueue(secret_url)
    assert not health.worker_is_well(settings)
    queue.announce(WorkerAddress(name="worker-7", endpoint="ipc://socket", device="cpu"))
    assert health.worker_is_well(settings)
    queue.withdraw("worker-7")
    assert not health.worker_is_well(settings)
    queue.close()


def test_what_does_not_answer_is_not_well(health: ModuleType, tmp_path: Path) -> None:
    with socket.socket() as nobody:  # bound, so that nobody else answers there
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        assert not health.service_is_well(Settings(data_dir=tmp_path, port=port))
        assert not health.worker_is_well(Settings(data_dir=tmp_path, redis_url=f"redis://127.0.0.1:{port}"))
