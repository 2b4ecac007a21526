"""Whatever is done to them in whatever order, the queue in memory and the queue on a server answer alike.

Times differ between the two and are left out of what is compared; leases do not run out here (test_queue_claims.py
lets them).
"""

from __future__ import annotations

import uuid
from itertools import pairwise
from typing import Any, ClassVar

import pytest
import redis
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from contract.queue.deliveries import ClaimedDelivery
from contract.queue.interface import Admission, Claim, Event, QueueFullError, place_of
from contract.queue.redis_queue import HELD, PREFIX, QUEUED, RedisQueue
from contract.wire.job import TERMINAL_STATES, TRANSITIONS, JobRecord, JobState
from contract.wire.labels import LabelChange
from contract.wire.webhooks import Delivery, DeliveryStatus, DeliveryTry, TryFailure
from intrasplat.options import Priority
from tests.contract.conftest import emptied
from tests.contract.queues import ERROR, TRAINING, job
from tests.memory_queue import MemoryQueue

OWNERS = st.sampled_from(["worker-1.a", "worker-1.b", "worker-2.a"])
PICK = st.integers(min_value=0, max_value=5)
ADMISSION = Admission(queued=4, queued_per_tenant=3)
TIMES = ("started_at_s", "finished_at_s")


def timeless(answer: object) -> object:
    """The answer without what depends on clocks; whether a time is there stays."""
    if isinstance(answer, JobRecord):
        return answer.model_copy(update={name: 1.0 for name in TIMES if getattr(answer, name) is not None})
    if isinstance(answer, Delivery):
        is_due = None if answer.next_try_at_s is None else 1.0
        return answer.model_copy(update={"ended_at_s": 1.0, "next_try_at_s": is_due})
    if isinstance(answer, ClaimedDelivery):
        return timeless(answer.delivery), answer.url, answer.tenant
    if isinstance(answer, Event):
        return timeless(answer.record)
    if isinstance(answer, list):
        return [timeless(each) for each in answer]
    return answer


class BothQueues(RuleBasedStateMachine):
    """Every rule does the same to both and compares what they say."""

    url: ClassVar[str]

    def __init__(self) -> None:
        super().__init__()
        emptied(self.url)
        self.memory = MemoryQueue(preempt_after_s=0.0)
        self.server = RedisQueue(self.url, preempt_after_s=0.0)
        self.client = redis.Redis.from_url(self.url, decode_responses=True)
        self.submitted: list[JobRecord] = []
        self.claims: list[Claim] = []

    def teardown(self) -> None:
        self.server.close()
        self.client.close()

    def both(self, method: str, *arguments: Any, **options: Any) -> Any:
        answers = []
        for queue in (self.memory, self.server):
            try:
                answers.append(getattr(queue, method)(*arguments, **options))
            except QueueFullError as error:
                answers.append(("full", error.tenant))
        assert timeless(answers[0]) == timeless(answers[1]), method
        return answers[0]

    def some_job(self, pick: int) -> str:
        return self.submitted[pick % len(self.submitted)].job_id if self.submitted else "0" * 32

    @rule(
        urgent=st.booleans(),
        tenant=st.sampled_from(["ward-1", "ward-2"]),
        key=st.sampled_from([None, None, "a" * 64, "b" * 64]),
        limited=st.booleans(),
        callback=st.sampled_from([None, "https://his.example/done"]),
    )
    def submit(self, urgent: bool, tenant: str, key: str | None, limited: bool, callback: str | None) -> None:
        created_at_s = 1000.0 + len(self.submitted) // 2
        priority: Priority = "high" if urgent else "standard"
        record = job(created_at_s, priority=priority, tenant=tenant, idempotency_key=key, callback_url=callback)
        self.submitted.append(record)
        self.both("submit", record, ADMISSION if limited else None)

    @rule(pick=PICK)
    def submit_again(self, pick: int) -> None:
        if self.submitted:
            self.both("submit", self.submitted[pick % len(self.submitted)])

    @rule(owner=OWNERS)
    def claim(self, owner: str) -> None:
        record = self.both("claim", owner, 0.0)
        if record is not None:
            self.claims.append(Claim(record.job_id, record.attempt, owner))

    @rule(pick=PICK, report=st.sampled_from(["finish", "fail", "confirm_cancel", "release", "die", "beat", "progress"]))
    def report(self, pick: int, report: str) -> None:
        if not self.claims:
            return
        claim = self.claims[-1 - pick % len(self.claims)]
        if report == "fail":
            self.both("fail", claim, ERROR)
        elif report == "die":
            self.both("release", claim, died=True)
        elif report == "progress":
            self.both("beat", claim, TRAINING.model_copy(update={"iteration": pick}))
        else:
            self.both(report, claim)

    @rule(pick=PICK, change=st.sampled_from(["cancel", "retry", "forget"]))
    def change(self, pick: int, change: str) -> None:
        self.both(change, self.some_job(pick))

    @rule(
        pick=PICK,
        label=st.sampled_from([{}, {"label": None}, {"label": "a"}, {"label": "b"}]),
        metadata=st.sampled_from([{}, {"metadata": None}, {"metadata": {"c": "d"}}]),
    )
    def relabel(self, pick: int, label: dict[str, Any], metadata: dict[str, Any]) -> None:
        self.both("relabel", self.some_job(pick), LabelChange(**label, **metadata))

    @rule(pick=PICK, limit=st.sampled_from([1, 2, None]), tenant=st.sampled_from(["ward-1", None]))
    def page(self, pick: int, limit: int | None, tenant: str | None) -> None:
        if self.submitted:
            self.both("records", tenant, limit, place_of(self.submitted[pick % len(self.submitted)]))

    @rule(pick=PICK, state=st.sampled_from(sorted(TERMINAL_STATES)))
    def restore(self, pick: int, state: JobState) -> None:
        if self.submitted:
            record = self.submitted[pick % len(self.submitted)]
            ended = {"state": state, "attempt": 1, "finished_at_s": 2000.0, "error": ERROR}
            self.both("restore", record.model_copy(update=ended))

    @rule(failure=st.sampled_from([None, TryFailure.TIMEOUT]), wait_s=st.sampled_from([0.0, 60.0]))
    def deliver(self, failure: TryFailure | None, wait_s: float) -> None:
        claims = {queue: queue.claim_delivery(uuid.uuid4().hex) for queue in (self.memory, self.server)}
        same = [timeless(claim) for claim in claims.values()]
        assert same[0] == same[1]
        for queue, claim in claims.items():
            if claim is not None:
                tries = (*claim.delivery.tries, DeliveryTry(at_s=1.0, failure=failure))
                status = DeliveryStatus.OWED if failure else DeliveryStatus.DELIVERED
                noted = claim.delivery.model_copy(update={"tries": tries, "status": status})
                assert queue.record_try(claim, noted, wait_s if failure else None)

    @rule(pick=PICK)
    def send_again(self, pick: int) -> None:
        record = self.server.get(self.some_job(pick))
        if record is not None and record.state in TERMINAL_STATES and record.callback_url is not None:
            self.both("send_again", record)

    @rule(pick=PICK)
    def look(self, pick: int) -> None:
        job_id = self.some_job(pick)
        self.both("get", job_id)
        self.both("deliveries", job_id)
        positions = {queue.forecast(job_id).position for queue in (self.memory, self.server)}
        assert len(positions) == 1

    @invariant()
    def they_hold_the_same(self) -> None:
        self.both("records")
        self.both("records", "ward-1")
        figures = [queue.figures() for queue in (self.memory, self.server)]
        assert len({(each.queued, each.running, tuple(sorted(each.ended.items()))) for each in figures}) == 1
        assert figures[0].webhooks == figures[1].webhooks
        for record in self.submitted[-3:]:
            self.both("events", record.job_id)

    @invariant()
    def events_follow_the_table(self) -> None:
        for record in self.submitted[-3:]:
            states = [event.record.state for event in self.server.events(record.job_id)]
            for before, after in pairwise(states):
                assert before is after or after in TRANSITIONS[before]

    @invariant()
    def the_indexes_agree_with_the_records(self) -> None:
        records = self.server.records(limit=None)
        queued = {record.job_id for record in records if record.state is JobState.QUEUED}
        running = {record.owner: record.job_id for record in records if record.state is JobState.RUNNING}
        failed = {record.job_id for record in records if record.state is JobState.FAILED}
        waiting = [self.client.zrange(f"{PREFIX}waiting:{priority}", 0, -1) for priority in ("high", "standard")]
        assert set().union(*waiting) == set(self.client.zrange(QUEUED, 0, -1)) == queued
        assert self.client.hgetall(HELD) == running
        assert set(self.client.zrange(PREFIX + "dead", 0, -1)) == failed
        entries = sum(self.client.xlen(f"{PREFIX}jobs:{priority}") for priority in ("high", "standard"))
        assert entries == len(queued) + len(running)


@pytest.mark.parametrize("server", ["valkey", "redis"])
def test_the_queue_in_memory_and_the_one_on_a_server_answer_alike(request: pytest.FixtureRequest, server: str) -> None:
    class OnServer(BothQueues):
        url = request.getfixturevalue(f"{server}_url")

    checks = settings(
        max_examples=30,
        stateful_step_count=30,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(OnServer, settings=checks)
