"""Loads the scripts that change the queue on Redis: contract/queue/scripts/*.lua, one for each atomic change.

Each script uses the server's clock. When it runs again because its answer was lost, it gives the same answer and
changes nothing. Its first line says whether it may run while the server's memory is full: scripts that finish work may.
Its header lists its arguments, the keys it touches, and its answer.
"""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from contract.queue.deliveries import OWED_FOR_S
from contract.queue.interface import MAX_ATTEMPTS, MAX_DURATIONS, MAX_EVENTS, YIELD_S, worker_died
from contract.queue.redis_client import reachable
from contract.queue.redis_hash import EVENT_FIELDS
from contract.wire.job import JobError, JobState, sources_of
from intrasplat.errors import ErrorCode
from intrasplat.names import BUDGETS_S

NAMES = (
    *("submit", "restore", "claim", "beat", "settle", "release", "cancel", "retry", "relabel", "forget"),
    *("claim_delivery", "record_try", "again", "announce"),
    *("open_feed", "claim_feed", "beat_feed", "leave_feed", "wish_feed"),
)

UNREADABLE = JobError(
    code=ErrorCode.RECORD_UNREADABLE,
    problem="The queue's record of this job cannot be read.",
    remedy="Retry it when no worker is of an earlier version than the service; else send the clip again.",
)


class Scripts:
    """The scripts on one server, for one queue.

    Args:
        prefix: the prefix of the queue's keys.
        lease_s, preempt_after_s: as in contract/queue/interface.py.
    """

    def __init__(self, client: Any, prefix: str, lease_s: float, preempt_after_s: float) -> None:
        self._scripts = {name: client.register_script(load_script(name)) for name in NAMES}
        self._prefix = prefix
        self._rules = _rules(lease_s, preempt_after_s)

    def run(self, name: str, *arguments: object) -> Any:
        """The answer of scripts/<name>.lua, whose header says what its arguments and its answer are."""
        with reachable():
            return self._scripts[name](keys=[self._prefix], args=[self._rules, *arguments])


def load_script(name: str) -> str:
    """The text that the server runs for scripts/<name>.lua: its first line, common.lua, and the rest of it."""
    folder = files("contract.queue") / "scripts"
    first_line, rest = (folder / f"{name}.lua").read_text(encoding="utf-8").split("\n", 1)
    return "\n".join([first_line, (folder / "common.lua").read_text(encoding="utf-8"), rest])


def _rules(lease_s: float, preempt_after_s: float) -> str:
    """The numbers of interface.py and the table of transitions, as the scripts read them (ARGV 1)."""
    rules = {
        "sources": {state: dict.fromkeys(sorted(sources_of(state)), True) for state in JobState},
        "lease_ms": round(lease_s * 1000),
        "preempt_ms": round(preempt_after_s * 1000),
        "yield_ms": round(YIELD_S * 1000),
        "max_attempts": MAX_ATTEMPTS,
        "worker_died": worker_died().model_dump_json(),
        "unreadable": UNREADABLE.model_dump_json(),
        "max_events": MAX_EVENTS,
        "event_fields": EVENT_FIELDS,
        "max_durations": MAX_DURATIONS,
        "owed_for_s": OWED_FOR_S,
        "budgets_s": dict(BUDGETS_S),
    }
    return json.dumps(rules)
