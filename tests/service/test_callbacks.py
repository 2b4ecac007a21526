"""Where webhooks may go: to hosts that the operator has named, at addresses that were judged, and nowhere else."""

from __future__ import annotations

import asyncio
import socket
import ssl
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from contract.runtime.settings import Settings
from intrasplat.errors import InputError
from service import webhooks
from service.callbacks import LookUps, permitted_addresses
from service.webhooks import MAX_TRIES
from tests.receiver import Receiver
from tests.service.telling import SECRET, accepted, cancelled, failure_of, log_of, sent, telling
from tests.service.under_test import assert_problem, bearer, running_service

ENDS_WITHIN_S = 120.0


def test_without_the_setting_a_callback_is_refused_with_what_the_operator_can_do(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        problem = assert_problem(sent(service, "https://his.example/hook"), 422, "callback_url")
        assert "INTRASPLAT_WEBHOOK_HOSTS" in problem["remedy"]
        assert service.spooled() == []


@pytest.mark.parametrize(
    "url",
    [
        "https://evil.example/",
        "http://his.example/",
        "https://his.example:8443/",
        "https://his.example.evil.example/",
        "https://user:word@his.example/",
        "https://evil.example@his.example/",
        "https://his.example/#part",
        "https://his.example/\r\nX-Header: 1",
        "https://his.example\\@evil.example/",
        "ftp://his.example/",
        "file:///etc/passwd",
        "//his.example/",
        "https://",
        "",
        "https://his.example/" + "x" * 1000,
    ],
)
def test_a_callback_elsewhere_is_refused(tmp_path: Path, url: str) -> None:
    for service in running_service(tmp_path, webhook_secret=SECRET, webhook_hosts=("his.example",)):
        assert_problem(sent(service, url), 422, "callback_url")
        scene = {"scene": ("a.zip", b"x")}
        assert_problem(service.http.post("/scenes", data={"callback_url": url}, files=scene), 422, "callback_url")
        assert service.spooled() == []


def test_a_host_is_allowed_in_any_case_and_with_its_own_port_named(tmp_path: Path) -> None:
    for service in running_service(tmp_path, webhook_secret=SECRET, webhook_hosts=("His.example", "http://b.example")):
        for url in ("https://his.EXAMPLE/a", "https://his.example:443", "http://b.example:80/?c=d"):
            accepted(service, url)


@pytest.mark.parametrize("hosts", ["https://a.example/path", "ftp://a.example", "a.example b.example", "u@a.example"])
def test_hosts_that_are_none_and_hosts_without_a_secret_are_refused_at_the_start(hosts: str) -> None:
    with pytest.raises(InputError, match="INTRASPLAT_WEBHOOK_HOSTS"):
        Settings.from_environment({"INTRASPLAT_WEBHOOK_HOSTS": hosts, "INTRASPLAT_WEBHOOK_SECRET": SECRET})
    with pytest.raises(InputError, match="INTRASPLAT_WEBHOOK_SECRET"):
        Settings.from_environment({"INTRASPLAT_WEBHOOK_HOSTS": "a.example"})


PRIVATE = (
    "10.1.2.3",
    "192.168.0.9",
    "127.0.0.1",
    "::1",
    "fd12::1",
    "::ffff:10.0.0.1",
    "64:ff9b::7f00:1",
    "2002:a00:1::",
)
CLOUDS = ("fd00:ec2::254", "fd20:ce::254", "fd00:c1::a9fe:a9fe", "::169.254.169.254", "64:ff9b:1::169.254.169.254")
NEVER = ("169.254.169.254", "::ffff:169.254.169.254", "fe80::1", "0.0.0.0", "::", "224.0.0.1", *CLOUDS)
PUBLIC = ("9.9.9.9", "2620:fe::fe")


def test_private_addresses_are_only_for_those_who_allow_them_and_metadata_for_nobody() -> None:
    careful, trusting = Settings(), Settings(webhook_private="yes")

    def permitted(settings: Settings) -> set[str]:
        return {each for each in every if asyncio.run(permitted_addresses(each, settings, LookUps(1)))}

    every = (*PRIVATE, *NEVER, *PUBLIC)
    assert permitted(careful) == {*PUBLIC}
    assert permitted(trusting) == {*PUBLIC, *PRIVATE}


def test_a_host_with_a_private_address_gets_nothing_unless_that_is_allowed(receiver: Receiver, tmp_path: Path) -> None:
    with telling(receiver, tmp_path, webhook_private="no") as service:
        assert failure_of(service, cancelled(service, f"{receiver.origin}/")) == ("address_refused", None)
        assert receiver.came.empty()


class Names:
    """A resolver whose names mean something else at every look-up."""

    def __init__(self, *addresses: str) -> None:
        self.answers = list(addresses)
        self.asked: list[object] = []
        self._real = socket.getaddrinfo

    def __call__(self, host: Any, port: Any, *more: Any, **named: Any) -> Any:
        if host in ("127.0.0.1", b"127.0.0.1"):
            return self._real(host, port, *more, **named)
        self.asked.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (self.answers.pop(0), port or 0))]


def test_the_address_that_was_judged_is_the_one_that_is_connected_to(
    receiver: Receiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = Names("127.0.0.1", "127.0.0.9")
    monkeypatch.setattr(socket, "getaddrinfo", names)
    origin = f"http://his.example:{receiver.port}"
    with telling(receiver, tmp_path, webhook_hosts=(origin,)) as service:
        job_id = cancelled(service, f"{origin}/hook")
        assert receiver.next().headers["host"] == f"his.example:{receiver.port}"
        log_of(service, job_id, lambda delivery: delivery["status"] == "delivered")
        assert len(names.asked) == 1


def test_names_whose_look_ups_hang_hold_up_no_other_receiver(
    receiver: Receiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, go_on, asked = socket.getaddrinfo, threading.Event(), threading.Semaphore(0)

    def hanging(host: Any, *more: Any, **named: Any) -> Any:
        if host == "hangs.example":
            asked.release()
            go_on.wait()
        return real("127.0.0.1" if host == "hangs.example" else host, *more, **named)

    monkeypatch.setattr(socket, "getaddrinfo", hanging)
    monkeypatch.setattr(webhooks, "TRY_S", 5.0)
    hangs, tenants = "http://hangs.example", 8
    with telling(receiver, tmp_path, webhook_hosts=(hangs, receiver.origin)) as service:
        try:
            for number in range(tenants * webhooks.MAX_OF_TENANT):
                job_id = accepted(service, f"{hangs}/", **bearer(service, f"ward-{number % tenants}"))
                service.queue.cancel(job_id)
            for _ in range(tenants * webhooks.MAX_OF_TENANT):
                assert asked.acquire(timeout=60.0)
            cancelled(service, f"{receiver.origin}/")
            receiver.next()
        finally:
            go_on.set()


HANGING_LOOK_UP = """
import socket, sys, threading
from pathlib import Path
from tests.receiver import Receiver
from tests.service.telling import cancelled, telling

real, asked = socket.getaddrinfo, threading.Event()

def hanging(host, *more, **named):
    if host == "hangs.example":
        asked.set()
        threading.Event().wait()
    return real(host, *more, **named)

socket.getaddrinfo = hanging
with Receiver() as receiver, telling(receiver, Path(sys.argv[1]), webhook_hosts=("http://hangs.example",)) as service:
    cancelled(service, "http://hangs.example/")
    assert asked.wait(60.0)
print("the service has ended", flush=True)
"""


def test_a_service_ends_while_a_resolver_hangs(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HANGING_LOOK_UP, str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=ENDS_WITHIN_S)
    assert (ended.returncode, ended.stdout) == (0, "the service has ended\n"), ended.stderr


def test_look_ups_are_bounded_and_a_cancelled_one_keeps_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    go_on = threading.Event()

    def hanging(host: str, *_: Any, **__: Any) -> Any:
        asked.append(host)
        go_on.wait()
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.0.1", 0))]

    monkeypatch.setattr(socket, "getaddrinfo", hanging)

    async def look_up() -> None:
        look_ups = LookUps(2)
        tasks = [asyncio.create_task(look_ups.addresses(f"{number}.example")) for number in range(3)]
        while len(asked) < 2:
            await asyncio.sleep(0.01)
        tasks[0].cancel()
        await asyncio.wait(tasks[:1])
        assert len(asked) == 2
        go_on.set()
        assert await asyncio.gather(*tasks[1:]) == [["127.0.0.1"]] * 2
        assert sorted(asked) == ["0.example", "1.example", "2.example"]

    asyncio.run(look_up())


def test_no_proxy_of_the_environment_is_used(
    receiver: Receiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Receiver() as proxy:
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "HTTPS_PROXY"):
            monkeypatch.setenv(name, proxy.origin)
        with telling(receiver, tmp_path) as service:
            cancelled(service, f"{receiver.origin}/")
            receiver.next()
        assert proxy.came.empty()


def test_nobody_at_the_address_is_told_as_such(receiver: Receiver, tmp_path: Path) -> None:
    with Receiver() as ended:
        origin = ended.origin
    with telling(receiver, tmp_path, webhook_hosts=(origin, "https://nowhere.invalid")) as service:
        assert failure_of(service, cancelled(service, f"{origin}/")) == ("unreachable", None)
        assert failure_of(service, cancelled(service, "https://nowhere.invalid/")) == ("unreachable", None)


def certificate(folder: Path, name: str) -> tuple[ssl.SSLContext, Path]:
    """A server's context with a certificate for that name which signs itself, and its file."""
    key, file = folder / f"{name}.key", folder / f"{name}.pem"
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", file, "-days", "2"]
    subprocess.run(
        [*made, "-subj", f"/CN={name}", "-addext", f"subjectAltName=DNS:{name}"], check=True, capture_output=True
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(file, key)
    return context, file


@pytest.mark.parametrize(("named", "trusted", "failure"), [
    ("his.example", True, None), ("other.example", True, "certificate"), ("his.example", False, "certificate"),
])  # fmt: skip
def test_over_tls_the_certificate_is_for_the_name_although_the_address_is_connected_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str, trusted: bool, failure: str | None
) -> None:
    context, file = certificate(tmp_path, named)
    if trusted:
        monkeypatch.setenv("SSL_CERT_FILE", str(file))
    monkeypatch.setattr(socket, "getaddrinfo", Names(*["127.0.0.1"] * MAX_TRIES))
    with Receiver(tls=context) as receiver:
        host = f"his.example:{receiver.port}"
        with telling(receiver, tmp_path / "data", webhook_hosts=(host,)) as service:
            assert failure_of(service, cancelled(service, f"https://{host}/"))[0] == failure
    assert receiver.came.empty() is (failure is not None)
