"""Records the actions of callers in the audit log (contract/access/audit.py). Calls block for one write to disk."""

from __future__ import annotations

import logging
import threading
from typing import Any

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditAction, AuditEntry, AuditLog, utc_now
from contract.runtime.logs import current_request_id
from intrasplat.errors import UnavailableError
from service.access import AccessRefusal, Caller
from service.problems import Problem

Note = tuple[str, tuple[str | None, ...]]
MINUTE_LENGTH = len("2026-01-31T12:59")
logger = logging.getLogger("intrasplat.service")


class Audit:
    """The audit log of one service."""

    def __init__(self, log: AuditLog) -> None:
        self._log = log
        self._lock = threading.Lock()
        self._minute = ""
        self._noted: set[Note] = set()

    def record(
        self, action: AuditAction, caller: Caller | None, job_id: str | None = None, outcome: str = "ok"
    ) -> None:
        """Record an action before it takes place. caller None: the service itself.

        Raises:
            UnavailableError: it cannot be recorded, so the action must not take place.
        """
        self._log.append(_entry(action, caller, job_id, outcome))

    async def viewed(self, caller: Caller, job_id: str) -> None:
        """Record that the caller views a scene, once a minute. Raises as record()."""
        entry = _entry(AuditAction.VIEWED, caller, job_id, "ok")
        if not self._is_noted(entry):
            await run_in_threadpool(self._once_a_minute, entry)

    async def refused(self, refusal: AccessRefusal) -> None:
        """Record a refusal, once a minute for each caller and reason. A failure to record it is not raised."""
        entry = _entry(AuditAction.REFUSED, refusal.caller, refusal.job_id, str(refusal.status))
        try:
            await run_in_threadpool(self._once_a_minute, entry.model_copy(update={"address": refusal.address}))
        except UnavailableError as error:
            logger.error("a refusal was not recorded in the audit: %s", type(error).__name__)

    def _once_a_minute(self, entry: AuditEntry) -> None:
        with self._lock:  # of simultaneous callers, one writes and the others wait for it
            if not self._is_noted(entry):
                self._log.append(entry)
                self._noted.add(_note(entry))

    def _is_noted(self, entry: AuditEntry) -> bool:
        note = _note(entry)
        if note[0] != self._minute:
            self._minute, self._noted = note[0], set()
        return note in self._noted


def _entry(action: AuditAction, caller: Caller | None, job_id: str | None, outcome: str) -> AuditEntry:
    who = (caller.tenant, caller.key_id, caller.address) if caller else (None, None, None)
    tenant, key_id, address = who
    return AuditEntry(
        time=utc_now(),
        action=action,
        outcome=outcome,
        job_id=job_id,
        tenant=tenant,
        key_id=key_id,
        address=address,
        request_id=current_request_id(),
    )


def _note(entry: AuditEntry) -> Note:
    """The key under which an entry counts as recorded: the minute and the fields that distinguish entries."""
    same = (entry.action, entry.outcome, entry.job_id, entry.tenant, entry.key_id, entry.address)
    return entry.time[:MINUTE_LENGTH], same


def install_refusal_handler(app: FastAPI, audit: Audit) -> None:
    """Record every refusal that leaves a route, then answer with its problem. Call after install_handlers()."""
    answer: Any = app.exception_handlers[Problem]

    async def on_refusal(connection: Any, error: Exception) -> Any:
        assert isinstance(error, AccessRefusal)
        await audit.refused(error)
        return await answer(connection, error)

    app.add_exception_handler(AccessRefusal, on_refusal)
