"""One kill: send a clip, hold a process at a point, kill, let everything restart, and check what became of the clip."""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx

from contract.queue.deliveries import DELIVERY_LEASE_S
from contract.wire.job import TERMINAL_STATES, JobRecord, JobState
from intrasplat.errors import SceneError, UnavailableError
from tests.chaos.deployment import TENANTS, Deployment, Victim
from tests.chaos.history import ClipHistory, violations
from tests.chaos.points import Point
from tests.receiver import Receiver, Webhook

CLIP = Path(__file__).resolve().parents[1] / "data" / "stereo_sbs_h264.mp4"
PADDING_BYTES = 200_000
ACCEPTED_WITHIN_S = 60.0
ENDED_WITHIN_S = 90.0
POINT_WITHIN_S = 40.0
SCORED_WITHIN_S = 30.0
TOLD_WITHIN_S = DELIVERY_LEASE_S + 30.0
"""How soon a webhook comes: the service that was to send it may be killed, and be killed again for another clip."""
SECOND_ENDING_S = 0.3
"""How long to wait before looking again at a job that has ended."""
TIDIED_WITHIN_S = 5.0
"""How soon the service's sweep removes the files of a cancelled job whose worker died."""
RETRY_PAUSE_S = 0.2

NO_MATTER = frozenset(
    (target, point)
    for target in (Victim.SUPERVISOR, Victim.CHILD)
    for point in (Point.UPLOAD, Point.SPOOLED, Point.TELLING, Point.TOLD)
)  # fmt: skip
"""Cells without meaning: the worker has no part in a clip before it is queued, nor in the webhook at its end."""

TURNS = itertools.cycle(TENANTS)
"""Whose clip is next."""

CELLS = [(target, point) for target in Victim for point in Point if (target, point) not in NO_MATTER]


@dataclass(frozen=True)
class Outcome:
    """The outcome of one kill."""

    history: ClipHistory
    violations: list[str]


class ChaosClient:
    """A client that sends one clip until it is accepted, always under the same idempotency key.

    headers: of its requests, such as a key. callback_url: where it wants to be told of the job's end.
    """

    def __init__(self, url: str, headers: Mapping[str, str] | None = None, callback_url: str | None = None) -> None:
        self._url = url
        self.headers = headers or {}
        self._texts = {} if callback_url is None else {"callback_url": callback_url}
        self._key = uuid.uuid4().hex
        self._body, self._type = _form(_clip_of_its_own(self._key), self._texts)
        self.job_id: str | None = None
        self._thread = threading.Thread(target=self._send_until_accepted, name="caller", daemon=True)

    def start(self) -> None:
        """Send in the background."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until the clip was accepted or given up."""
        self._thread.join()

    def send_half(self) -> socket.socket:
        """An upload that stops in the middle; the connection stays open until the caller closes it."""
        address = urlsplit(self._url)
        assert address.hostname is not None
        connection = socket.create_connection((address.hostname, address.port), timeout=10)
        own = "".join(f"{name}: {value}\r\n" for name, value in self.headers.items())
        head = (
            f"POST /reconstruct HTTP/1.1\r\nHost: {address.netloc}\r\n{own}Content-Type: {self._type}\r\n"
            f"Idempotency-Key: {self._key}\r\nContent-Length: {len(self._body)}\r\n\r\n"
        )
        connection.sendall(head.encode() + self._body[: len(self._body) // 2])
        return connection

    def _send_until_accepted(self) -> None:
        deadline_s = time.monotonic() + ACCEPTED_WITHIN_S
        headers = {**self.headers, "Content-Type": self._type, "Idempotency-Key": self._key}
        while time.monotonic() < deadline_s:
            with suppress(httpx.HTTPError, json.JSONDecodeError):
                answer = httpx.post(f"{self._url}/reconstruct", content=self._body, headers=headers, timeout=30)
                if answer.status_code == 202:
                    self.job_id = answer.json()["id"]
                    return
            time.sleep(RETRY_PAUSE_S)


def run_kill(deployment: Deployment, target: Victim, point: Point, cancels: bool) -> Outcome:
    """Kill `target` while a clip is at `point`; with `cancels`, after asking to cancel it."""
    deployment.points.reset()
    history = ClipHistory((target.value, point.value), told=[])
    caller = new_caller(deployment)
    half: socket.socket | None = None
    if point is Point.UPLOAD:
        half = caller.send_half()
        time.sleep(0.1)  # the half arrives
    else:
        deployment.points.arm(point)
        caller.start()
        deployment.points.wait_for(point, POINT_WITHIN_S)
    if cancels:
        caller.wait()
        history.cancel_heard = _cancel(deployment, caller)
    history.killed_at_s = time.time()
    deployment.kill(target)
    deployment.points.let_go()
    if half is not None:
        half.close()
        caller.start()
    deployment.wait_until_ready()
    history.restart_s = time.time() - history.killed_at_s if target in (Victim.VALKEY, Victim.ALL) else 0.0
    caller.wait()
    history.job_id = caller.job_id
    watch(deployment, history)
    return Outcome(history, violations(history, deployment.store))


def new_caller(deployment: Deployment) -> ChaosClient:
    """A caller of one of several tenants, who wants a webhook; its path names the tenant."""
    tenant = next(TURNS)
    return ChaosClient(deployment.url, deployment.keys[tenant], f"{deployment.receiver.origin}/{tenant}")


def _cancel(deployment: Deployment, caller: ChaosClient) -> bool:
    if caller.job_id is None:
        return False
    with suppress(httpx.HTTPError):
        answer = httpx.delete(f"{deployment.url}/jobs/{caller.job_id}", headers=caller.headers, timeout=10)
        return answer.status_code == 200 and (
            answer.json()["cancel_requested"] or answer.json()["state"] == "cancelled"
        )
    return False


def watch(deployment: Deployment, history: ClipHistory) -> None:
    """Watch until the job has ended, and a moment longer to see a second ending."""
    if history.job_id is None:
        return
    record = wait_until_ended(deployment, history.job_id, ENDED_WITHIN_S)
    if record is not None and record.state is JobState.DONE:
        history.scored = _wait_until_scored(deployment, record)
    time.sleep(SECOND_ENDING_S if record is not None and record.state is JobState.DONE else TIDIED_WITHIN_S)
    history.events = deployment.queue.events(history.job_id)
    if history.told is not None:
        history.told = _wait_until_told(deployment.receiver, history.job_id)


def _wait_until_told(receiver: Receiver, job_id: str) -> list[Webhook]:
    """The webhooks about a job that came within TOLD_WITHIN_S, once there is any."""
    deadline_s = time.monotonic() + TOLD_WITHIN_S
    while True:
        told = [each for each in list(receiver.all) if each.document["data"]["job_id"] == job_id]
        if told or time.monotonic() > deadline_s:
            return told
        time.sleep(0.05)


def _wait_until_scored(deployment: Deployment, record: JobRecord) -> bool:
    """Whether the scene's scores came within SCORED_WITHIN_S."""
    deadline_s = time.monotonic() + SCORED_WITHIN_S
    while time.monotonic() < deadline_s:
        with suppress(UnavailableError, SceneError):
            if deployment.store.newest_report(record.job_id, record.attempt).scored:
                return True
        time.sleep(0.05)
    return False


def wait_until_ended(deployment: Deployment, job_id: str, timeout_s: float) -> JobRecord | None:
    """The record of the ended job, or the last one seen before timeout_s; None if none was seen."""
    deadline_s = time.monotonic() + timeout_s
    record: JobRecord | None = None
    while time.monotonic() < deadline_s:
        with suppress(UnavailableError):
            record = deployment.queue.get(job_id)
            if record is not None and record.state in TERMINAL_STATES:
                break
        time.sleep(0.05)
    return record


def _clip_of_its_own(name: str) -> bytes:
    """The clip with a unique box at its end, which players skip."""
    padding = name.encode() * (PADDING_BYTES // len(name))
    return CLIP.read_bytes() + struct.pack(">I4s", 8 + len(padding), b"free") + padding


def _form(clip: bytes, texts: Mapping[str, str]) -> tuple[bytes, str]:
    boundary = uuid.uuid4().hex
    parts = [
        f'--{boundary}\r\nContent-Disposition: form-data; name="{each}"\r\n\r\n{texts[each]}\r\n' for each in texts
    ]
    parts += [f'--{boundary}\r\nContent-Disposition: form-data; name="clip"; filename="clip.mp4"\r\n\r\n']
    head = "".join(parts)
    return head.encode() + clip + f"\r\n--{boundary}--\r\n".encode(), f"multipart/form-data; boundary={boundary}"
