"""Failures other than deaths: a worker that sleeps past its lease and wakes, and a faulty network."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from contract.queue.interface import LEASE_S
from contract.wire.job import TERMINAL_STATES, JobState
from tests.chaos.campaign import ChaosClient, new_caller, wait_until_ended, watch
from tests.chaos.deployment import Deployment, children_of
from tests.chaos.history import ClipHistory, orphans, violations
from tests.chaos.points import Point
from tests.chaos.proxy import ChaosProxy, Fault

SLEEP_S = LEASE_S + 4.0
SETTLED_WITHIN_S = 60.0

WIRE_FAULTS = (
    (Fault.DELAY, 6.0),
    (Fault.DROP_REPLY, 8.0),
    (Fault.HALF_OPEN, 5.0),
    (Fault.PARTITION, 12.0),
    (Fault.DROP_REPLY, 8.0),
)
"""What the network does, and for how many seconds. It works for a second in between. PARTITION outlasts the lease."""
WIRE_PAUSE_S = 1.0
WIRE_JOBS = 25


@dataclass(frozen=True)
class ScenarioResult:
    """A scenario, what was seen in it, and the laws it broke."""

    name: str
    seen: str
    violations: list[str]


def zombie(folder: Path, port: int, point: Point) -> ScenarioResult:
    """SIGSTOP the worker that holds a job at `point` past its lease, let the other finish, SIGCONT the first."""
    with Deployment(folder, port, workers=2) as deployment:
        caller = new_caller(deployment)
        deployment.points.arm(point)
        caller.start()
        held = deployment.points.wait_for(point, 40.0)
        caller.wait()
        assert caller.job_id is not None
        sleepers = _family_of(held, deployment)
        for process_id in sleepers:
            os.kill(process_id, signal.SIGSTOP)
        stopped_s = time.time()
        deployment.points.let_go()  # which the sleepers hear of only when they wake
        record = wait_until_ended(deployment, caller.job_id, SETTLED_WITHIN_S)
        if record is None or record.state not in TERMINAL_STATES:
            raise TimeoutError(f"job {caller.job_id} was not taken over within {SETTLED_WITHIN_S:g} s")
        taken_over_s = time.time() - stopped_s
        time.sleep(max(0.0, SLEEP_S - taken_over_s))
        for process_id in sleepers:
            with suppress(ProcessLookupError):
                os.kill(process_id, signal.SIGCONT)
        time.sleep(3.0)  # the zombie tries to publish
        history = ClipHistory(("zombie", point.value), caller.job_id, killed_at_s=stopped_s, told=[])
        watch(deployment, history)
        broken = violations(history, deployment.store)
        if history.events[-1].record.attempt != 2:
            broken.append(f"attempt {history.events[-1].record.attempt} won")
        seen = f"another worker was done {taken_over_s:.1f} s after the first was stopped"
        return ScenarioResult(f"zombie, stopped {point.value}", seen, broken)


def bad_wire(folder: Path, port: int, seed: int) -> ScenarioResult:
    """Two workers behind a faulty network while jobs come in."""
    with Deployment(folder, port, workers=0) as deployment, ChaosProxy(deployment.socket, seed) as proxy:
        deployment.add_workers(2, redis_url=f"redis://127.0.0.1:{proxy.port}/0")
        deployment.wait_until_ready()
        callers: list[ChaosClient] = []
        for fault, seconds in WIRE_FAULTS:
            proxy.set(fault)
            for _ in range(WIRE_JOBS // len(WIRE_FAULTS)):
                callers.append(new_caller(deployment))
                callers[-1].start()
                time.sleep(seconds * len(WIRE_FAULTS) / WIRE_JOBS)
            proxy.set(Fault.NONE)
            time.sleep(WIRE_PAUSE_S)
        broken, attempts = [], 0
        for caller in callers:
            caller.wait()
            history = ClipHistory(("wire", ""), caller.job_id, told=[])
            watch(deployment, history)
            broken += violations(history, deployment.store)
            attempts += history.events[-1].record.attempt if history.events else 0
        records = deployment.queue.records(limit=None)
        if len(records) != WIRE_JOBS:
            broken.append(f"{WIRE_JOBS} clips became {len(records)} jobs")
        if {record.state for record in records} != {JobState.DONE}:
            broken.append("not every job is done")
        if orphans(deployment.store, {record.job_id for record in records}):
            broken.append("folders that belong to no job")
        faults = ", ".join(f"{fault.value} {seconds:g} s" for fault, seconds in WIRE_FAULTS)
        return ScenarioResult(f"wire: {faults}", f"{WIRE_JOBS} clips, {len(records)} jobs, {attempts} attempts", broken)


def _family_of(process_id: int, deployment: Deployment) -> list[int]:
    """The supervisor and child to which a process belongs."""
    for kept in deployment.workers:
        supervisor = kept.process_id
        if supervisor is not None and process_id in (supervisor, *children_of(supervisor)):
            return [supervisor, *children_of(supervisor)]
    raise AssertionError(f"process {process_id} belongs to no worker")
