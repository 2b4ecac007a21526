"""Purges jobs after their retention_hours, or else the deployment's, and never later than its maximum."""

from __future__ import annotations

import asyncio
import logging
import time

from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditLog
from contract.queue.interface import Queue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.job import TERMINAL_STATES, JobRecord
from intrasplat.errors import InputError, UnavailableError
from intrasplat.options import JobOptions
from service.purge import Purger, try_to_purge

LOOK_PERIOD_S = 300.0
"""Interval of the checks. Each check reads all records."""

HOUR_S = 3600.0
logger = logging.getLogger("intrasplat.service")


def check_retention(options: JobOptions, settings: Settings) -> None:
    """Return if a job may be kept as long as it requests.

    Raises:
        InputError: it requests more than settings.max_retention_hours.
    """
    asked, most = options.retention_hours, settings.max_retention_hours
    if asked is not None and most is not None and asked > most:
        problem = f"{asked:g} is longer than the {most:g} hours that anything is kept here."
        raise InputError("options.retention_hours", problem, f"Ask for {most:g} or less, or leave it out.")


def retention_hours(options: JobOptions, settings: Settings) -> float | None:
    """How many hours a job is kept after its end; None: until it is deleted."""
    wanted = settings.retention_hours if options.retention_hours is None else options.retention_hours
    limits = [hours for hours in (wanted, settings.max_retention_hours) if hours is not None]
    return min(limits, default=None)


class Retention:
    """Purges jobs whose retention has expired. One service of a data directory does so at a time. Services on several
    machines may do so at once, because a purge may be repeated."""

    def __init__(self, settings: Settings, queue: Queue, store: Store, purger: Purger) -> None:
        self._settings = settings
        self._queue = queue
        self._purger = purger
        self._audit_log = AuditLog(settings.data_dir)
        self._lock = FolderLock(store.run_dir / "retention.lock")

    async def run(self) -> None:
        """Check every LOOK_PERIOD_S, until cancelled."""
        try:
            while True:
                await run_in_threadpool(self._try_to_purge_due)
                await asyncio.sleep(LOOK_PERIOD_S)
        finally:
            self._lock.release()

    def purge_due(self, now_s: float) -> int:
        """Finish interrupted removals, and purge jobs that are due at now_s (UNIX time). Returns how many."""
        self._purger.finish_cut_off()
        due = [record.job_id for record in self._queue.records(None, None) if self._is_due(record, now_s)]
        purged = sum(try_to_purge(self._purger, job_id, "retention") for job_id in due)
        self._purger.clear_log()
        return purged

    def _is_due(self, record: JobRecord, now_s: float) -> bool:
        hours = retention_hours(record.options, self._settings)
        ended_s = record.finished_at_s
        if hours is None or ended_s is None or record.state not in TERMINAL_STATES:
            return False
        return ended_s + hours * HOUR_S <= now_s

    def _try_to_purge_due(self) -> None:
        if not self._lock.take():
            return
        self._audit_log.fill_reserve()
        try:
            self.purge_due(time.time())
        except UnavailableError as error:
            logger.warning("retention waits: %s", error.problem)
        except OSError as error:
            logger.error("retention cannot work", extra={"error": type(error).__name__})
