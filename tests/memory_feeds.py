"""Live feeds inside one process; the queue in memory calls each method under its lock."""

from __future__ import annotations

import time

from contract.queue.feeds import FeedClaim, check_feeds
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish


class MemoryFeeds:
    """The feeds and their leases."""

    def __init__(self, lease_s: float) -> None:
        self._lease_s = lease_s
        self._records: dict[str, FeedRecord] = {}
        self._lease_ends_s: dict[str, float] = {}
        self._left: set[tuple[FeedClaim, bool]] = set()
        self.unreadable: set[str] = set()
        """Feeds whose records cannot be read."""

    def open(self, record: FeedRecord, most: int, most_of_tenant: int) -> FeedRecord:
        if record.feed_id not in self._records:
            of_tenant = len(self.all(record.tenant))
            check_feeds(len(self._records), most, of_tenant, most_of_tenant)
            self._records[record.feed_id] = record
            self._left = {each for each in self._left if each[0].feed_id != record.feed_id}
        return self._records[record.feed_id]

    def claim(self, owner: str, *, to_end: bool) -> FeedRecord | None:
        for record in sorted(self._records.values(), key=lambda each: (each.created_at_s, each.feed_id)):
            followed_by = self._owner(record)
            is_of_same_worker = followed_by is not None and followed_by.rpartition(".")[0] == owner.rpartition(".")[0]
            is_free = followed_by is None or (is_of_same_worker and followed_by != owner)
            if is_free and (record.wish is FeedWish.END or not to_end):
                claimed = record.model_copy(update={"owner": owner, "epoch": record.epoch + 1})
                self._records[record.feed_id] = claimed
                self._lease_ends_s[record.feed_id] = time.monotonic() + self._lease_s
                return claimed
        return None

    def beat(self, claim: FeedClaim, report: FeedReport) -> FeedWish | None:
        if not self._is_of(claim):
            return None
        changes = {"report": report, "reported_at_s": time.time()}
        self._records[claim.feed_id] = self._records[claim.feed_id].model_copy(update=changes)
        self._lease_ends_s[claim.feed_id] = time.monotonic() + self._lease_s
        return self._records[claim.feed_id].wish

    def leave(self, claim: FeedClaim, *, has_ended: bool) -> bool:
        if (claim, has_ended) in self._left:
            return True
        if not self._is_of(claim):
            return False
        if has_ended:
            if self._records[claim.feed_id].wish is not FeedWish.END:
                return False
            del self._records[claim.feed_id]
        else:
            self._records[claim.feed_id] = self._records[claim.feed_id].model_copy(update={"owner": None})
        self._left.add((claim, has_ended))
        return True

    def wish(self, feed_id: str, wish: FeedWish) -> FeedRecord | None:
        record = self._records.get(feed_id)
        if record is not None and wish is FeedWish.END and record.epoch == 0:
            del self._records[feed_id]
        elif record is not None and record.wish is not FeedWish.END:
            self._records[feed_id] = record.model_copy(update={"wish": wish})
        return self.one(feed_id)

    def one(self, feed_id: str) -> FeedRecord | None:
        record = None if feed_id in self.unreadable else self._records.get(feed_id)
        return record and record.model_copy(update={"owner": self._owner(record)})

    def tenant(self, feed_id: str) -> str | None:
        return self._records[feed_id].tenant if feed_id in self._records else None

    def all(self, tenant: str | None) -> list[FeedRecord]:
        found = [self.one(each) for each in self._records]
        shown = [each for each in found if each is not None and tenant in (None, each.tenant)]
        return sorted(shown, key=lambda each: (each.created_at_s, each.feed_id), reverse=True)

    def _owner(self, record: FeedRecord) -> str | None:
        return record.owner if self._lease_ends_s.get(record.feed_id, 0.0) > time.monotonic() else None

    def _is_of(self, claim: FeedClaim) -> bool:
        record = self._records.get(claim.feed_id)
        return record is not None and (record.owner, record.epoch) == (claim.owner, claim.epoch)
