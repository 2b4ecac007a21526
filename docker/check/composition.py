"""The services of docker/compose.yml, run by podman as that file says."""

from __future__ import annotations

import json
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml  # type: ignore[import-untyped]

DOCKER = Path(__file__).resolve().parent.parent
PROJECT = "intrasplat-check"
"""The beginning of the name of everything that is made here."""
VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")
START_TIMEOUT_S = 600.0
"""Of a worker that compiles its kernels on a busy machine."""
STEP_TIMEOUT_S = 300.0

Service = dict[str, Any]

TRANSLATED: dict[str, Callable[[Any], list[str]]] = {
    # Left alone, podman lets everybody write to memory on /run and /var/tmp.
    "read_only": lambda value: ["--read-only", "--read-only-tmpfs=false"] if value else [],
    "tmpfs": lambda values: [f"--tmpfs={each}" for each in values],
    "cap_drop": lambda values: [f"--cap-drop={each}" for each in values],
    "security_opt": lambda values: [f"--security-opt={each.removesuffix(':true')}" for each in values],
    "init": lambda value: ["--init"] if value else [],
    "logging": lambda value: [
        f"--log-driver={value['driver']}",
        *(f"--log-opt={name}={option}" for name, option in value["options"].items()),
    ],
    "user": lambda value: [f"--user={value}"],
    "environment": lambda values: [f"--env={name}={value}" for name, value in values.items()],
    # It needs a folder that it can make their files in, which only root can write to.
    "secrets": lambda values: [
        "--tmpfs=/run/secrets:mode=755",
        *(f"--secret={PROJECT}-{each},target={each}" for each in values),
    ],
    "volumes": lambda values: [f"--volume={PROJECT}-{each}" for each in values],
    "mem_limit": lambda value: [f"--memory={value}"],
    "pids_limit": lambda value: [f"--pids-limit={value}"],
    "stop_grace_period": lambda value: [f"--stop-timeout={value.removesuffix('s')}"],
}
"""By key of a service: podman's options for what it asks of Docker."""
DONE_OTHERWISE = frozenset({"image", "command", "build", "depends_on", "healthcheck", "restart", "networks", "ports"})
"""Of these, `restart` is left out: a container that ends by itself is to be seen."""


def composed(text: str, variables: Mapping[str, str]) -> dict[str, Any]:
    """What compose.yml says where the environment has these variables."""
    filled = VARIABLE.sub(lambda found: variables.get(found[1]) or found[2], text)
    document: dict[str, Any] = yaml.safe_load(filled)
    return document


def options(service: Service) -> list[str]:
    """podman's options for a service.

    Raises:
        ValueError: the service asks for something that is not translated here.
    """
    unknown = service.keys() - TRANSLATED.keys() - DONE_OTHERWISE
    if unknown:
        raise ValueError(f"docker/check does not know {', '.join(sorted(unknown))} of compose.yml: translate it")
    return [option for key, value in service.items() if key in TRANSLATED for option in TRANSLATED[key](value)]


def podman(*arguments: str, fails: bool = False) -> str:
    """What podman prints. fails: whether it may fail; then it is all that it says."""
    command = ["podman", *arguments]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=STEP_TIMEOUT_S, check=False)
    if answer.returncode != 0 and not fails:
        raise RuntimeError(f"{' '.join(command)}: status {answer.returncode}\n{answer.stderr.strip()}")
    return answer.stdout.strip() if not fails else f"{answer.stdout}{answer.stderr}".strip()


class Composition:
    """Networks, volumes and secrets of the file while it is open; a service runs once it was started."""

    def __init__(self, hosts: str) -> None:
        """hosts: the value of INTRASPLAT_HOSTS."""
        self._hosts = hosts
        self._ending = ExitStack()
        self.services: dict[str, Service] = {}

    def __enter__(self) -> Composition:
        text = (DOCKER / "compose.yml").read_text(encoding="utf-8")
        file = composed(text, {})
        with self._ending as ending:
            for name in file["services"]:
                self._remove("rm", name, "--force", "--time=1")  # what a check that was killed has left
            for name, network in file["networks"].items():
                self._make("network", name, *(["--internal"] if network.get("internal") else []))
            for name in file["volumes"]:
                self._make("volume", name)
            folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
            subprocess.run([DOCKER / "make-secrets.sh", folder / "secrets"], check=True, capture_output=True)
            for name, secret in file["secrets"].items():
                self._make("secret", name, last=str(folder / secret["file"]))
            self.gateway = json.loads(podman("network", "inspect", f"{PROJECT}-outside"))[0]["subnets"][0]["gateway"]
            variables = {"INTRASPLAT_HOSTS": self._hosts, "FORWARDED_ALLOW_IPS": self.gateway}
            self.services = composed(text, variables)["services"]
            self._ending = ending.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.close()

    def _make(self, kind: str, name: str, *arguments: str, last: str | None = None) -> None:
        self._remove(kind, name, "rm")
        self._ending.callback(self._remove, kind, name, "rm")
        podman(kind, "create", *arguments, f"{PROJECT}-{name}", *([last] if last else []))

    @staticmethod
    def _remove(kind: str, name: str, *arguments: str) -> None:
        podman(kind, *arguments, f"{PROJECT}-{name}", fails=True)

    def start(self, name: str) -> float:
        """Start a service; the seconds until its own health check says that it is well."""
        service, began_s = self.services[name], time.monotonic()
        networks = [f"--network={PROJECT}-{each}:alias={name}" for each in service["networks"]]
        ports = [f"--publish={each}" for each in service.get("ports", [])]
        health = self._health(service)
        # Without systemd nothing would run the check by itself, so it is run here.
        given = [f"--name={PROJECT}-{name}", "--detach", "--no-healthcheck", *networks, *ports, *options(service)]
        self._ending.callback(self._remove, "rm", name, "--force", "--time=1")
        podman("run", *given, service["image"], *service.get("command", []))
        while self.status(name, *health) != 0:
            if self.field(name, "State.Running") != "true" or time.monotonic() > began_s + START_TIMEOUT_S:
                raise RuntimeError(f"{name} does not become well; its log ends:\n{self.log(name)[-3000:]}")
            time.sleep(0.1)
        return time.monotonic() - began_s

    def stop(self, name: str) -> float:
        """SIGTERM, and SIGKILL after the time that the file gives; the seconds until it has ended."""
        began_s = time.monotonic()
        podman("stop", f"{PROJECT}-{name}")
        return time.monotonic() - began_s

    def start_again(self, name: str) -> None:
        """Start a service that was stopped."""
        podman("start", f"{PROJECT}-{name}")

    def once(self, name: str, *command: str, mounts: Mapping[Path, str] | None = None) -> str:
        """What a command prints in a container of its own, as `docker compose run --rm --no-deps`."""
        given = [f"--volume={path}:{inside}" for path, inside in (mounts or {}).items()]
        service = self.services[name]
        return podman("run", "--rm", "--network=none", *options(service), *given, service["image"], *command)

    def run(self, name: str, *command: str) -> str:
        """What a command prints in a running container."""
        return podman("exec", f"{PROJECT}-{name}", *command)

    def status(self, name: str, *command: str) -> int:
        """The exit status of a command in a running container."""
        given = ["podman", "exec", f"{PROJECT}-{name}", *command]
        return subprocess.run(given, capture_output=True, timeout=STEP_TIMEOUT_S, check=False).returncode

    def field(self, name: str, path: str) -> str:
        """A field of `podman inspect`."""
        return podman("inspect", "--format", f"{{{{.{path}}}}}", f"{PROJECT}-{name}")

    def changed(self, name: str) -> list[str]:
        """Paths outside of volumes that the container has changed."""
        return podman("diff", f"{PROJECT}-{name}", fails=True).splitlines()

    def log(self, name: str) -> str:
        """All that the container has said."""
        return podman("logs", f"{PROJECT}-{name}", fails=True)

    def _health(self, service: Service) -> list[str]:
        if "healthcheck" in service:
            test = service["healthcheck"]["test"]
        else:
            image = json.loads(podman("image", "inspect", service["image"]))[0]
            health = image.get("HealthCheck") or image.get("Healthcheck")
            if not health:
                raise RuntimeError(f"{service['image']} has no health check: build it with --format docker")
            test = health["Test"]
        return ["sh", "-c", test[1]] if test[0] == "CMD-SHELL" else list(test[1:])
