"""Live feeds on Redis or Valkey; contract/queue/redis_queue.py lists the keys."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from contract.queue.feeds import FEED_LEASE_S, FeedClaim, check_feeds
from contract.queue.lua import Scripts
from contract.queue.redis_client import reachable
from contract.queue.redis_hash import table_of
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish

CHANGING = {"wish", "owner", "epoch", "report", "reported_at_s"}
"""Fields of a record that stand in fields of the hash of their own."""

logger = logging.getLogger("intrasplat.queue")


class RedisFeeds:
    """The methods of RedisQueue that implement Feeds."""

    def __init__(self, client: Any, scripts: Scripts, prefix: str, feed_lease_s: float = FEED_LEASE_S) -> None:
        self._client = client
        self._scripts = scripts
        self._prefix = prefix
        self._feed_lease_ms = round(feed_lease_s * 1000)

    def open_feed(self, record: FeedRecord, most: int, most_of_tenant: int) -> FeedRecord:
        document = record.model_dump_json(exclude=CHANGING)
        created = repr(record.created_at_s)
        answer = self._scripts.run("open_feed", record.feed_id, record.tenant, document, created, most, most_of_tenant)
        if answer[0] == "full":
            check_feeds(answer[1], most, answer[2], most_of_tenant)
        return _record_of(table_of(answer[1])) or record

    def claim_feed(self, owner: str, *, to_end: bool = False) -> FeedRecord | None:
        answer = self._scripts.run("claim_feed", owner, self._feed_lease_ms, "1" if to_end else "")
        return _record_of(table_of(answer[1])) if answer else None

    def beat_feed(self, claim: FeedClaim, report: FeedReport) -> FeedWish | None:
        document = report.model_dump_json(exclude_defaults=True)
        wish = self._scripts.run("beat_feed", claim.feed_id, claim.owner, claim.epoch, document, self._feed_lease_ms)
        return FeedWish(wish) if wish else None

    def release_feed(self, claim: FeedClaim) -> bool:
        return bool(self._scripts.run("leave_feed", claim.feed_id, claim.owner, claim.epoch, ""))

    def forget_feed(self, claim: FeedClaim) -> bool:
        return bool(self._scripts.run("leave_feed", claim.feed_id, claim.owner, claim.epoch, "1"))

    def wish_feed(self, feed_id: str, wish: FeedWish) -> FeedRecord | None:
        return _record_of(table_of(self._scripts.run("wish_feed", feed_id, wish.value)))

    def feed(self, feed_id: str) -> FeedRecord | None:
        found = self._feeds([feed_id])
        return found[0] if found else None

    def tenant_of_feed(self, feed_id: str) -> str | None:
        with reachable():
            tenant: str | None = self._client.hget(f"{self._prefix}feed:{feed_id}", "tenant")
        return tenant

    def feeds(self, tenant: str | None = None) -> list[FeedRecord]:
        index = f"{self._prefix}feeds" if tenant is None else f"{self._prefix}feeds:{tenant}"
        with reachable():
            feed_ids = self._client.zrevrange(index, 0, -1)
        return self._feeds(feed_ids)

    def _feeds(self, feed_ids: list[str]) -> list[FeedRecord]:
        if not feed_ids:
            return []
        with reachable(), self._client.pipeline(transaction=False) as batch:
            batch.time()
            for feed_id in feed_ids:
                batch.hgetall(f"{self._prefix}feed:{feed_id}")
            (seconds, microseconds), *hashes = batch.execute()
        found = [_record_of(fields, seconds + microseconds / 1e6) for fields in hashes]
        return [record for record in found if record is not None]


def _record_of(fields: Mapping[str, str], clock_s: float = 0.0) -> FeedRecord | None:
    """The record in a feed's hash; None if the hash is empty, or if it cannot be read, which is logged.

    clock_s: UNIX time; the owner is None if its lease has expired by then.
    """
    if not fields:
        return None
    report, is_followed = fields.get("report"), float(fields.get("lease", "0")) > clock_s
    try:
        return FeedRecord.model_validate_json(fields["document"], extra="ignore").model_copy(
            update={
                "wish": FeedWish(fields["wish"]),
                "owner": fields.get("owner") if is_followed else None,
                "epoch": int(fields["epoch"]),
                "report": FeedReport.model_validate_json(report) if report else None,
                "reported_at_s": float(fields["reported"]) if "reported" in fields else None,
            }
        )
    except (ValueError, KeyError) as error:
        logger.error("The record of a feed cannot be read.", extra={"error": type(error).__name__})
        return None
