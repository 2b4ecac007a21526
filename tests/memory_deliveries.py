"""Deliveries inside one process; the queue in memory calls each method under its lock."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection

from contract.queue.deliveries import DELIVERY_LEASE_S, ClaimedDelivery
from contract.wire.job import JobRecord
from contract.wire.webhooks import Delivery, DeliveryStatus


class MemoryDeliveries:
    """Which webhooks are owed, and what became of the others."""

    def __init__(self) -> None:
        self.ended: Counter[DeliveryStatus] = Counter()
        self._all: dict[str, Delivery] = {}
        """By event."""
        self._due_at_s: dict[str, float] = {}
        self._event_of_token: dict[str, str] = {}
        """Event by token."""
        self._tenants: dict[str, str] = {}
        """By event."""
        self._trying: dict[str, float] = {}
        """By event: when the claim runs out, UNIX s."""

    @property
    def owed(self) -> int:
        """How many are owed."""
        return len(self._due_at_s)

    def add(self, record: JobRecord) -> None:
        """The delivery of a job that has just ended, if it has a callback."""
        delivery = Delivery.of(record)
        if record.callback_url is not None and delivery.event_id not in self._all:
            self._set_due(delivery, record.tenant)

    def claim(self, token: str, skipped: Collection[str]) -> tuple[Delivery, str] | None:
        """The delivery and its due_score."""
        event = self._event_of_token.get(token)
        if event not in self._due_at_s:
            now_s = time.time()
            due = [
                each
                for each, due_at_s in self._due_at_s.items()
                if due_at_s <= now_s and self._tenants[each] not in skipped
            ]
            if not due:
                return None
            event = self._event_of_token[token] = min(due, key=self._due_at_s.__getitem__)
            self._due_at_s[event] = self._trying[event] = now_s + DELIVERY_LEASE_S
        return self._all[event], repr(self._due_at_s[event])

    def record_try(self, claim: ClaimedDelivery, delivery: Delivery, wait_s: float | None) -> bool:
        """As Deliveries.record_try has it."""
        event = delivery.event_id
        if self._all.get(event) == delivery:
            return True
        if event not in self._due_at_s or repr(self._due_at_s[event]) != claim.due_score:
            return False
        self._all[event] = delivery
        self._trying.pop(event, None)
        if wait_s is None:
            del self._due_at_s[event]
            self.ended[delivery.status] += 1
        else:
            self._due_at_s[event] = time.time() + wait_s
        return True

    def send_again(self, record: JobRecord) -> None:
        """As Deliveries.send_again has it, of a job that is as the record says."""
        delivery = Delivery.of(record)
        if not self._is_tried(delivery.event_id):
            self._set_due(self._all.get(delivery.event_id, delivery).again(), record.tenant)

    def of(self, job_id: str) -> list[Delivery]:
        """The deliveries of a job, with when they are tried next."""
        found = [each for each in self._all.values() if each.job_id == job_id]
        return [each.model_copy(update={"next_try_at_s": self._next_at_s(each.event_id)}) for each in found]

    def forget(self, job_id: str) -> None:
        """Owe nothing of a job that is removed, and remember nothing of it."""
        for delivery in self.of(job_id):
            del self._all[delivery.event_id]
            del self._tenants[delivery.event_id]
            self._due_at_s.pop(delivery.event_id, None)
            self._trying.pop(delivery.event_id, None)

    def _set_due(self, delivery: Delivery, tenant: str) -> None:
        self._all[delivery.event_id] = delivery
        self._due_at_s[delivery.event_id] = time.time()
        self._tenants[delivery.event_id] = tenant

    def _is_tried(self, event: str) -> bool:
        return self._trying.get(event, 0.0) > time.time()

    def _next_at_s(self, event: str) -> float | None:
        return None if self._is_tried(event) else self._due_at_s.get(event)
