"""The part of the queue that stores live feeds (`Feeds`, a Protocol).

A feed is followed by one worker at a time. Its claim is a lease, as that of a job: FEED_LEASE_S after the last beat any
worker with a free place may claim it, in a new epoch. Reports of an earlier epoch change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from intrasplat.errors import ErrorCode, UnavailableError

FEED_BEAT_S = 0.5
"""How often a worker reports on a feed that it follows."""
FEED_LEASE_S = 4.0
"""How long a claim is valid without a beat."""


class FeedsFullError(UnavailableError):
    """As many feeds as are allowed are open. tenant: the caller's own (HTTP 429), not those of all (503)."""

    code = ErrorCode.FEEDS_FULL

    def __init__(self, problem: str, remedy: str, *, tenant: bool) -> None:
        super().__init__(problem, remedy)
        self.tenant = tenant


@dataclass(frozen=True)
class FeedClaim:
    """One epoch of a feed and the worker that follows it."""

    feed_id: str
    epoch: int
    owner: str


class Feeds(Protocol):
    """Every method is atomic, and may be repeated when its answer was lost; all raise UnavailableError."""

    def open_feed(self, record: FeedRecord, most: int, most_of_tenant: int) -> FeedRecord:
        """Add a feed. Returns the record that the queue has for it: the one that is there if the id is known.

        Raises:
            FeedsFullError: most feeds, or most_of_tenant of this tenant, are open; nothing was changed.
        """
        ...

    def claim_feed(self, owner: str, *, to_end: bool = False) -> FeedRecord | None:
        """Claim the oldest feed that nobody follows, for FEED_LEASE_S, in a new epoch; None: there is none.

        Feeds that are to end are claimed, too: their worker deletes what it has of them. to_end: claim only such a
        feed, which needs no free place. An owner whose name before the last dot is the same takes a feed over at once:
        a worker has one process of its name.
        """
        ...

    def beat_feed(self, claim: FeedClaim, report: FeedReport) -> FeedWish | None:
        """Renew the lease and store the report. Returns what the caller wants; None: the claim is no longer valid."""
        ...

    def release_feed(self, claim: FeedClaim) -> bool:
        """Let another worker claim the feed at once; False if the claim is no longer valid."""
        ...

    def wish_feed(self, feed_id: str, wish: FeedWish) -> FeedRecord | None:
        """Change what the caller wants. END is never taken back. Returns the record; None if there is none.

        A feed that no worker ever claimed ends at once: its record is removed.
        """
        ...

    def forget_feed(self, claim: FeedClaim) -> bool:
        """Remove a feed that its worker has ended; False if the claim is no longer valid or the wish is not END."""
        ...

    def feed(self, feed_id: str) -> FeedRecord | None:
        """The feed's record; None if there is none or it cannot be read.

        Its owner is None when the claim has expired.
        """
        ...

    def tenant_of_feed(self, feed_id: str) -> str | None:
        """The tenant of the feed, also where its record cannot be read; None: there is no such feed."""
        ...

    def feeds(self, tenant: str | None = None) -> list[FeedRecord]:
        """The feeds of one tenant or of all, newest first. Records that cannot be read are skipped."""
        ...


def check_feeds(open_feeds: int, most: int, of_tenant: int, most_of_tenant: int) -> None:
    """Refuse another feed if too many are open.

    Raises:
        FeedsFullError: the tenant's share or the whole number is used up.
    """
    if of_tenant >= most_of_tenant:
        problem = f"{of_tenant} of your feeds are open; the limit is {most_of_tenant}."
        raise FeedsFullError(problem, "End one: DELETE /feeds/{id}.", tenant=True)
    if open_feeds >= most:
        problem = f"{open_feeds} feeds are open; the limit is {most}."
        raise FeedsFullError(problem, "Try again when one has ended.", tenant=False)
