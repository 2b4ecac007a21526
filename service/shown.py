"""What a caller looks at: a finished scene, a job that trains, or a live feed of its tenant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from opentelemetry.trace import get_current_span
from starlette.concurrency import run_in_threadpool

from contract.access.keys import KeyScope
from contract.runtime import traces
from contract.store.shelf import is_job_id
from contract.wire.job import JobState
from intrasplat.live.state import FeedState
from service.access import AccessRefusal, Caller
from service.deps import Deps, no_such_scene, owned_scene
from service.filenames import stem_of
from service.listing import SceneSearch
from service.moments import feed_time, scene_time
from service.problems import Problem


@dataclass(frozen=True)
class Shown:
    """What a caller sees: the scene that `attempt` finished; None: the running job's newest snapshot, or a feed."""

    scene_id: str
    attempt: int | None
    feed_state: FeedState | None = None
    stem: str = ""
    """Of the names of files that are made of it."""

    @property
    def is_feed(self) -> bool:
        """Whether it is a live feed."""
        return self.feed_state is not None

    @property
    def state(self) -> JobState | FeedState:
        """Of the scene, the job, or the feed."""
        if self.feed_state is not None:
            return self.feed_state
        return JobState.RUNNING if self.attempt is None else JobState.DONE

    def time_fields(self, asked: float | str | None) -> dict[str, Any]:
        """The fields of a request to the worker that name the time.

        Raises:
            InputError: it is no time of a scene, or no moment of a feed.
        """
        return {"t": 0.0, "moment": feed_time(asked)} if self.is_feed else {"t": scene_time(asked)}


async def find_shown(services: Deps, caller: Caller, scene: str | None, *, with_feeds: bool = False) -> Shown:
    """Find the named scene, or the tenant's only one, and record in the audit log that the caller views it.

    with_feeds: `scene` may be a live feed.

    Raises:
        Problem: 400: no scene is named and the tenant has not exactly one (never show another patient by accident).
            403: the key lacks the scope. 404: the tenant has no such scene. 409: the job has nothing to show.
            503: it had a snapshot, and waits for another worker.
    """
    caller.require(KeyScope.VIEW)
    with traces.span("find"):
        shown = await run_in_threadpool(_find, services, caller, scene, with_feeds)
    traces.describe(get_current_span(), job_id=shown.scene_id)
    await services.audit.viewed(caller, shown.scene_id)
    return shown


def _find(services: Deps, caller: Caller, scene: str | None, with_feeds: bool) -> Shown:
    if scene is None:
        return _only(services, caller)
    if with_feeds:
        return scene_or_feed(services, caller, scene, _find_scene)
    return _find_scene(services, caller, scene)


def _find_scene(services: Deps, caller: Caller, scene: str) -> Shown:
    record = owned_scene(services, caller, scene)
    if record.state is JobState.DONE:
        return Shown(scene, record.attempt)
    if record.state is JobState.RUNNING:
        return Shown(scene, None)
    if record.state is JobState.QUEUED and record.attempt > 0:
        remedy = "Ask again in some seconds, when another worker has claimed it."
        raise Problem(503, "The job's worker has ended, and the job is queued again.", field="scene", remedy=remedy)
    detail = f"The job is {record.state}; there is nothing to show."
    waits = record.state is JobState.QUEUED
    remedy = f"Wait for its first view: GET /jobs/{scene}/events." if waits else f"GET /jobs/{scene} says why."
    raise Problem(409, detail, field="scene", remedy=remedy)


def scene_or_feed(
    services: Deps, caller: Caller, scene: str, find_scene: Callable[[Deps, Caller, str], Shown]
) -> Shown:
    """What find_scene finds, or the caller's live feed of that id. Scenes cost no look for a feed."""
    if not services.feeds.is_known(scene):
        try:
            return find_scene(services, caller, scene)
        except Problem as problem:
            if problem.status != 404 or isinstance(problem, AccessRefusal) or not is_job_id(scene):
                raise
    record = services.feeds.record(scene)
    if record is None or not caller.owns(record):
        raise no_such_scene(scene, caller, record)
    stem = stem_of(record.options.label, record.created_at_s, scene)
    return Shown(scene, None, record.state, stem)


def _only(services: Deps, caller: Caller) -> Shown:
    page, _ = services.done.page_of(caller.tenant, SceneSearch())
    there = [record for record in page.records if services.store.has_scene(record.job_id, record.attempt)]
    if len(there) != 1 or page.end is not None:
        if not there and page.end is None:
            raise Problem(400, "There is no finished scene.", field="scene", remedy="Send a clip: POST /reconstruct.")
        detail = f"There are {len(there)}{' or more' if page.end else ''} scenes, and the request names none."
        raise Problem(400, detail, field="scene", remedy="Add scene=ID; GET /scenes lists them.")
    return Shown(there[0].job_id, there[0].attempt)
