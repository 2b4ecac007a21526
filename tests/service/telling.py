"""A service that may send webhooks to a receiver, and what the tests of them say often."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from contract.queue.interface import Queue
from tests.receiver import Receiver
from tests.service.under_test import CLIP, ServiceUnderTest, running_service

SECRET = "s" * 32
PATIENT = "series Quokka"
LOG_WITHIN_S = 60.0


@contextmanager
def telling(receiver: Receiver, folder: Path, queue: Queue | None = None, **changes: Any) -> Iterator[ServiceUnderTest]:
    """A service that may send webhooks to the receiver."""
    settings = {"webhook_secret": SECRET, "webhook_hosts": (receiver.origin,), "webhook_private": "yes", **changes}
    yield from running_service(folder, queue, **settings)


def sent(service: ServiceUnderTest, url: str, clip: bytes = CLIP, **headers: str) -> Any:
    data = {"callback_url": url, "label": PATIENT}
    return service.http.post("/reconstruct", files={"clip": ("Quokka.mp4", clip)}, data=data, headers=headers)


def accepted(service: ServiceUnderTest, url: str, **headers: str) -> str:
    response = sent(service, url, **headers)
    assert response.status_code == 202, response.text
    job_id: str = response.json()["id"]
    return job_id


def cancelled(service: ServiceUnderTest, url: str, **headers: str) -> str:
    job_id = accepted(service, url, **headers)
    service.http.delete(f"/jobs/{job_id}")
    return job_id


def log_of(service: ServiceUnderTest, job_id: str, until: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The only delivery of a job, once it is as expected."""
    deadline_s = time.monotonic() + LOG_WITHIN_S
    while True:
        (delivery,) = service.http.get(f"/jobs/{job_id}/deliveries").json()
        if until(delivery):
            return delivery
        assert time.monotonic() < deadline_s, delivery
        time.sleep(0.02)


def failure_of(service: ServiceUnderTest, job_id: str) -> tuple[str | None, int | None]:
    """Failure and status of the first try of a job's only webhook."""
    first = log_of(service, job_id, lambda delivery: bool(delivery["tries"]))["tries"][0]
    return first["failure"], first["status_code"]
