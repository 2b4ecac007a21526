"""What the application passes to routes: the parts of the service, and the caller.

Every route takes AnyCaller and requires a scope, except those of service/system.py that report nothing about jobs:

    def list_jobs(services: Services, caller: AnyCaller) -> ...:
        caller.require(KeyScope.VIEW)
"""

from __future__ import annotations

from ipaddress import ip_address
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from contract.access.audit import AuditLog
from contract.queue.interface import Queue
from contract.runtime.settings import Settings
from contract.store.feed_files import FeedFiles
from contract.store.shelf import is_job_id
from contract.store.store import Store
from contract.wire.feeds import FeedRecord
from contract.wire.job import JobRecord
from intrasplat.errors import UnavailableError
from service.access import Access, AccessRefusal, Caller, key_missing
from service.audit import Audit
from service.done import DoneJobs
from service.events import JobChannels
from service.feed_events import FeedChannels
from service.feed_records import FeedRecords
from service.followed import FollowedFeeds
from service.intake import Intake
from service.limits import Limiter
from service.metrics import Metrics
from service.problems import SCENES_REMEDY, Problem
from service.purge import Purger
from service.query import check_query
from service.questions import Questions
from service.render_limits import RenderLimits
from service.renderer import Renderer
from service.retention import Retention
from service.sweep import Sweep
from service.webhooks import Webhooks

UNIX_SOCKET = "unix"
NO_ADDRESS = "unknown"


class Deps:
    """The parts of the service: four that are passed in, and others built from those."""

    def __init__(self, settings: Settings, queue: Queue, store: Store, renderer: Renderer) -> None:
        self.settings = settings
        self.queue = queue
        self.store = store
        self.renderer = renderer
        # access and its audit log
        self.access = Access(settings)
        self.limiter = Limiter(settings.requests_per_s)
        self.render_limits = RenderLimits(settings)
        self.audit = Audit(AuditLog(settings.data_dir))
        self.metrics = Metrics(queue, store)
        # uploads, events and webhooks of jobs, removal
        self.intake = Intake(settings, store)
        self.sweep = Sweep(queue, store)
        self.job_channels = JobChannels(queue)
        self.webhooks = Webhooks(settings, queue)
        self.questions = Questions()
        self.done = DoneJobs(queue, store, self.questions)
        self.purger = Purger(queue, store, self.audit, self.done)
        # live feeds
        self.feed_channels = FeedChannels(queue)
        self.feed_files = FeedFiles(settings.data_dir)
        self.feeds = FeedRecords(queue, self.questions)
        self.followed = FollowedFeeds()
        self.retention = Retention(settings, queue, store, self.purger)

    def end_channels(self) -> None:
        """End all streams of events. May be called from a signal handler."""
        self.job_channels.end()
        self.feed_channels.end()


def _deps_of(connection: HTTPConnection) -> Deps:
    deps = connection.app.state.deps
    assert isinstance(deps, Deps)
    return deps


Services = Annotated[Deps, Depends(_deps_of)]


def address_of(connection: HTTPConnection) -> str:
    """The caller's address, which only trusted proxies may set; nothing but an IP address."""
    if connection.client is None:
        return UNIX_SOCKET
    try:
        return str(ip_address(connection.client.host.partition("%")[0]))  # without the zone, which is any text
    except ValueError:
        return NO_ADDRESS


async def _caller_if_known(connection: HTTPConnection, services: Services) -> Caller | None:
    address = address_of(connection)
    caller = services.access.caller(connection.headers, address)
    services.limiter.admit(caller.key_id or address if caller else address)
    return caller


async def _caller(connection: HTTPConnection, caller: Annotated[Caller | None, Depends(_caller_if_known)]) -> Caller:
    if caller is None:
        raise key_missing(address_of(connection))
    check_query(connection)
    return caller


AnyCaller = Annotated[Caller, Depends(_caller)]
"""The caller of a request or WebSocket. Without a valid key where one is needed: 401, before any handshake."""

EarlyCaller = Annotated[Caller | None, Depends(_caller_if_known)]
"""The caller of a WebSocket, or None if the key has to come in its first message, because browsers send no header.
services.access.caller_of_key(text, address) then gives the caller."""


def owned_job(services: Deps, caller: Caller, job_id: str) -> JobRecord:
    """The record of a job of the caller's tenant. A missing job and another tenant's job give the same 404."""
    record = services.queue.get(job_id) if is_job_id(job_id) else None
    if record is not None and caller.owns(record):
        return record
    raise not_found(f"There is no job {job_id[:40]!r}.", "job_id", "GET /jobs lists what there is.", caller, record)


def owned_scene(services: Deps, caller: Caller, scene_id: str) -> JobRecord:
    """As owned_job(), for a scene or the job that will become one. Finds finished scenes without the queue, too."""
    record = services.done.record(scene_id) if is_job_id(scene_id) else None
    if record is not None and caller.owns(record):
        return record
    raise no_such_scene(scene_id, caller, record)


def owned_feed(services: Deps, caller: Caller, feed_id: str) -> FeedRecord:
    """As owned_job(), for a live feed, as the queue has it now.

    Raises:
        UnavailableError: its record cannot be read.
    """
    record = services.queue.feed(feed_id) if is_job_id(feed_id) else None
    if record is not None and caller.owns(record):
        return record
    if record is None and is_job_id(feed_id) and services.queue.tenant_of_feed(feed_id) == caller.tenant:
        problem = f"The record of feed {feed_id} cannot be read."
        raise UnavailableError(problem, "Start service and worker from the same version, and ask again.")
    raise not_found(f"There is no feed {feed_id[:40]!r}.", "feed_id", "GET /feeds lists what there is.", caller, record)


def no_such_scene(scene_id: str, caller: Caller, record: JobRecord | FeedRecord | None) -> Problem:
    """not_found() of a scene."""
    return not_found(f"There is no scene {scene_id[:40]!r}.", "scene", SCENES_REMEDY, caller, record)


def not_found(detail: str, field: str, remedy: str, caller: Caller, record: JobRecord | FeedRecord | None) -> Problem:
    """The same 404 for what does not exist and for what is another tenant's; the audit log records only the latter."""
    if record is None:
        return Problem(404, detail, field=field, remedy=remedy)
    owned_id = record.feed_id if isinstance(record, FeedRecord) else record.job_id
    return AccessRefusal(404, detail, remedy, field=field, address=caller.address, caller=caller, job_id=owned_id)
