"""Three services and four workers on one queue, under load from several tenants.

One load is run, and each test looks at one law: an accepted job ends once, no worker has two jobs at a time, tenants
take turns, and every service answers about every job, by pictures too. The laws hold by the clock of the queue's
server, however fast the machine is.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import httpx
import pytest

from contract.access.keys import DEFAULT_SCOPES, KeyFile
from contract.queue.interface import Event
from contract.wire.job import TERMINAL_STATES, JobState
from tests.chaos.campaign import ChaosClient, watch
from tests.chaos.deployment import Deployment
from tests.chaos.history import ClipHistory, orphans, violations
from tests.chaos.trainer import PICTURE, VIEWS
from tests.test_many_machines import free_port

PATIENCE_S = 300.0
WORKERS = 4
GREEDY, MODEST = "greedy", "modest"
GREEDY_JOBS = 50
WARDS = ("ward-1", "ward-2", "ward-3")
JOBS_EACH = 8
CANCEL_EVERY = 6


@dataclass(frozen=True)
class Run:
    """One attempt at a job, by the clock of the queue's server.

    queued_s    when it waited for certain: events have milliseconds, rounded down
    started_s   inf: it never ran
    """

    job_id: str
    tenant: str
    owner: str
    queued_s: float
    started_s: float
    finished_s: float

    def runs_at(self, time_s: float) -> bool:
        return self.started_s < time_s < self.finished_s

    def waits_at(self, time_s: float) -> bool:
        return self.queued_s <= time_s < min(self.started_s, self.finished_s)


def run_of(events: Sequence[Event]) -> Run:
    """The only attempt at a job that has ended."""
    last = events[-1].record
    assert last.attempt <= 1, "a worker was silent for 8 s: this machine is too busy for this test"
    assert last.finished_at_s is not None
    return Run(
        job_id=last.job_id,
        tenant=last.tenant,
        owner=last.owner or "",
        queued_s=(int(events[0].number.partition("-")[0]) + 1) / 1000,
        started_s=float("inf") if last.started_at_s is None else last.started_at_s,
        finished_s=last.finished_at_s,
    )


@dataclass(frozen=True)
class Load:
    """What was sent and what became of it. statuses: of views, by service."""

    deployment: Deployment
    keys: dict[str, dict[str, str]]
    histories: list[ClipHistory]
    statuses: dict[str, Counter[int]]

    @property
    def runs(self) -> list[Run]:
        return [run_of(history.events) for history in self.histories]


class Senders:
    """Send jobs of several tenants to the services in turn."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment = deployment
        self._urls = itertools.cycle(deployment.urls)
        keys = KeyFile(deployment.data_dir)
        self.keys = {
            tenant: {"Authorization": f"Bearer {keys.create(tenant, DEFAULT_SCOPES)[1]}"}
            for tenant in (GREEDY, MODEST, *WARDS)
        }
        self.histories: list[ClipHistory] = []

    def send(self, tenant: str) -> None:
        """Return when a job of the tenant is accepted."""
        caller = ChaosClient(next(self._urls), self.keys[tenant])
        caller.start()
        caller.wait()
        self.histories.append(ClipHistory((tenant, ""), caller.job_id))

    def cancel(self, history: ClipHistory) -> None:
        """Ask for it, at another service than the one that took the job; the job may have ended (409)."""
        address, key = f"{next(self._urls)}/jobs/{history.job_id}", self.keys[history.cell[0]]
        answer = httpx.delete(address, headers=key, timeout=30.0)
        assert answer.status_code in (200, 409), answer.text
        history.cancel_heard = answer.status_code == 200 and answer.json()["state"] != JobState.DONE

    def watch(self) -> None:
        """Return when all jobs have ended."""
        with ThreadPoolExecutor(8) as threads:
            list(threads.map(lambda history: watch(self._deployment, history), self.histories))


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """Fifty jobs of one tenant wait. When the first is done, another sends one, and then all wards send at once."""
    folder = tmp_path_factory.mktemp("load") / "site"
    more_ports = [free_port(), free_port()]
    with Deployment(folder, free_port(), workers=0, more_ports=more_ports, **{VIEWS: "1"}) as deployment:
        senders = Senders(deployment)
        with ThreadPoolExecutor(len(WARDS)) as threads:
            list(threads.map(senders.send, [GREEDY] * GREEDY_JOBS))
            deployment.add_workers(WORKERS)
            deployment.wait_until_ready()
            with viewing(deployment, senders.keys[GREEDY]) as statuses:
                senders.send(MODEST)
                list(threads.map(lambda ward: [senders.send(ward) for _ in range(JOBS_EACH)], WARDS))
                for history in senders.histories[::-CANCEL_EVERY]:
                    senders.cancel(history)
                senders.watch()
        yield Load(deployment, senders.keys, senders.histories, statuses)


@contextmanager
def viewing(deployment: Deployment, key: dict[str, str]) -> Iterator[dict[str, Counter[int]]]:
    """Look at a finished scene through every service as long as the context lasts; which status came how often."""
    scene = ""

    def is_done() -> bool:
        nonlocal scene
        done = [each.job_id for each in deployment.queue.records(GREEDY) if each.state is JobState.DONE]
        scene = done[0] if done else ""
        return bool(done)

    eventually(is_done)
    end = threading.Event()
    statuses: dict[str, Counter[int]] = {url: Counter() for url in deployment.urls}

    def look(url: str) -> None:
        while not end.wait(0.05):
            query = {"t": 0.5, "scene": scene, "format": "jpeg"}
            answer = httpx.get(f"{url}/render", params=query, headers=key, timeout=60.0)
            assert answer.content == PICTURE if answer.is_success else answer.headers["retry-after"]
            statuses[url][answer.status_code] += 1

    with ThreadPoolExecutor(len(deployment.urls)) as threads:
        viewers = [threads.submit(look, url) for url in deployment.urls]
        try:
            yield statuses
        finally:
            end.set()
        for viewer in viewers:
            viewer.result()


def eventually(happens: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_every_accepted_job_ends_once_and_leaves_one_scene_or_none(load: Load) -> None:
    broken = {history.job_id: violations(history, load.deployment.store) for history in load.histories}
    assert not any(broken.values()), broken
    assert len(load.histories) == len(load.deployment.queue.records(limit=None))
    assert len(load.histories) == GREEDY_JOBS + 1 + JOBS_EACH * len(WARDS)
    assert any(history.final is JobState.CANCELLED for history in load.histories)
    assert orphans(load.deployment.store, {run.job_id for run in load.runs}) == []


def test_no_worker_has_two_jobs_at_a_time(load: Load) -> None:
    ran = sorted((run for run in load.runs if run.owner), key=lambda run: (run.owner, run.started_s))
    assert len({run.owner for run in ran}) == WORKERS
    for earlier, later in itertools.pairwise(ran):
        assert earlier.owner != later.owner or earlier.finished_s < later.started_s


def test_one_job_behind_fifty_of_another_tenant_is_before_all_that_had_not_begun(load: Load) -> None:
    (modest,) = (run for run in load.runs if run.tenant == MODEST)
    greedy = [run for run in load.runs if run.tenant == GREEDY]
    assert [run for run in greedy if modest.queued_s < run.started_s < modest.started_s] == []
    assert sum(run.started_s > modest.started_s for run in greedy) > WORKERS


def test_no_job_begins_while_one_of_a_tenant_with_fewer_running_waits(load: Load) -> None:
    runs = load.runs
    for run in runs:
        running = Counter(each.tenant for each in runs if each.runs_at(run.started_s))
        waiting = {each.tenant for each in runs if each.waits_at(run.started_s)}
        before = [tenant for tenant in waiting if running[tenant] < running[run.tenant]]
        assert before == [], f"{run} began before jobs of {before} while {running} ran"


def test_every_service_shows_pictures_while_the_workers_train(load: Load) -> None:
    for statuses in load.statuses.values():
        assert set(statuses) <= {200, 503}
        assert statuses[200] > 0


def test_every_service_lists_every_job_to_its_tenant_alone(load: Load) -> None:
    for (tenant, key), url in itertools.product(load.keys.items(), load.deployment.urls):
        listed = httpx.get(f"{url}/jobs", headers=key, timeout=30.0).json()
        assert {each["id"] for each in listed} == {run.job_id for run in load.runs if run.tenant == tenant}
        assert {JobState(each["state"]) for each in listed} <= TERMINAL_STATES
