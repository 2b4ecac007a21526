"""What routes work with, handed to them by the application: the parts of the service, and who calls.

Every route but those of service/system.py that say nothing of anybody's work takes AnyCaller, and requires a scope:

    def list_jobs(services: Services, caller: AnyCaller) -> ...:
        caller.require(KeyScope.VIEW)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from contract.job import JobRecord
from contract.queue import Queue
from contract.settings import Settings
from contract.store import Store, is_job_id
from service.access import Access, Caller, key_missing
from service.problems import Problem
from service.renderer import Renderer


@dataclass(frozen=True)
class Deps:
    """What the service is made of; what follows from the settings alone is made here."""

    settings: Settings
    queue: Queue
    store: Store
    renderer: Renderer
    access: Access = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "access", Access(self.settings))


def _deps_of(connection: HTTPConnection) -> Deps:
    deps = connection.app.state.deps
    assert isinstance(deps, Deps)
    return deps


Services = Annotated[Deps, Depends(_deps_of)]


async def _caller_if_known(connection: HTTPConnection, services: Services) -> Caller | None:
    address = connection.client.host if connection.client else "-"
    return services.access.caller(connection.headers, address)


async def _caller(caller: Annotated[Caller | None, Depends(_caller_if_known)]) -> Caller:
    if caller is None:
        raise key_missing()
    return caller


AnyCaller = Annotated[Caller, Depends(_caller)]
"""Of a request or a WebSocket; without a known key where one is needed it is answered 401, before any handshake."""

EarlyCaller = Annotated[Caller | None, Depends(_caller_if_known)]
"""For a WebSocket whose key may come in its first message, since browsers send no header: None means that it must.
services.access.caller_of_key(text, address) then says whose it is."""


def owned_job(services: Deps, caller: Caller, job_id: str) -> JobRecord:
    """The record of a job of the caller's tenant; the same 404 if there is none and if it is another's."""
    record = services.queue.get(job_id) if is_job_id(job_id) else None
    if record is None or not caller.owns(record):
        remedy = "GET /jobs lists what there is."
        raise Problem(404, f"There is no job {job_id[:40]!r}.", field="job_id", remedy=remedy)
    return record
