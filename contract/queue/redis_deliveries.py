"""Deliveries on Redis or Valkey; contract/queue/redis_queue.py lists the keys."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any

from contract.queue.deliveries import DELIVERY_LEASE_S, ClaimedDelivery, delivery_of
from contract.queue.lua import Scripts
from contract.queue.redis_client import reachable
from contract.wire.job import JobRecord
from contract.wire.webhooks import Delivery, DeliveryStatus

logger = logging.getLogger("intrasplat.queue")


class RedisDeliveries:
    """The methods of RedisQueue that implement Deliveries."""

    def __init__(self, client: Any, scripts: Scripts, prefix: str) -> None:
        self._client = client
        self._scripts = scripts
        self._prefix = prefix

    def claim_delivery(self, token: str, skipped: Collection[str] = ()) -> ClaimedDelivery | None:
        while answer := self._scripts.run("claim_delivery", token, round(DELIVERY_LEASE_S * 1000), *skipped):
            event, document, url, tenant, due_score, trace = answer
            if delivery := delivery_of(document):
                return ClaimedDelivery(delivery, url, tenant, due_score, trace or None)
            if self._scripts.run("record_try", event, due_score, "", DeliveryStatus.FAILED.value, "", tenant):
                logger.error("A webhook cannot be read and is given up.", extra={"job_id": event.partition(".")[0]})
        return None

    def record_try(self, claim: ClaimedDelivery, delivery: Delivery, wait_s: float | None) -> bool:
        wait_ms = "" if wait_s is None else round(wait_s * 1000)
        arguments = (
            delivery.event_id,
            claim.due_score,
            _document(delivery),
            delivery.status.value,
            wait_ms,
            claim.tenant,
        )
        return bool(self._scripts.run("record_try", *arguments))

    def send_again(self, record: JobRecord) -> None:
        delivery = Delivery.of(record)
        with reachable():
            known = self._client.hget(self._key(record.job_id), delivery.event_id) or ""
        again = (delivery_of(known) or delivery).again()
        self._scripts.run("again", delivery.event_id, known, _document(again))

    def deliveries(self, job_id: str) -> list[Delivery]:
        with reachable():
            found = [each for each in map(delivery_of, self._client.hvals(self._key(job_id))) if each]
            if not found:
                return []
            tenant = self._client.hget(f"{self._prefix}job:{job_id}", "tenant")
            with self._client.pipeline(transaction=True) as batch:
                batch.zmscore(f"{self._prefix}tenant:{tenant}:owed", [each.event_id for each in found])
                batch.mget([f"{self._prefix}trying:{each.event_id}" for each in found])
                due, trying = batch.execute()
        next_s = [None if is_tried else at_s for at_s, is_tried in zip(due, trying, strict=True)]
        views = [each.model_copy(update={"next_try_at_s": at_s}) for each, at_s in zip(found, next_s, strict=True)]
        return sorted(views, key=lambda each: each.ended_at_s)

    def _key(self, job_id: str) -> str:
        return f"{self._prefix}deliveries:{job_id}"


def _document(delivery: Delivery) -> str:
    """The delivery as stored; the sorted set of its tenant holds the time at which it is due."""
    return delivery.model_dump_json(exclude={"next_try_at_s"})
