"""The part of the queue that stores which webhooks have yet to be delivered (`Deliveries`, a Protocol).

A job's end and its delivery are written in one step, so neither a killed worker nor a killed service loses a delivery.
A service claims a delivery that is due. A claim is a lease: if the service reports no result before it expires,
another service may claim the delivery. So each webhook is sent at least once, and twice only if a service died, or
lost the queue, in between.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

from contract.wire.job import JobRecord
from contract.wire.webhooks import Delivery

DELIVERY_LEASE_S = 30.0
"""The length of a claim; longer than an attempt takes (service/webhooks.py)."""


OWED_FOR_S = 26 * 3600.0
"""A webhook that the queue has lost becomes due again, unless its job ended longer ago than this: attempts have
usually stopped by then."""


@dataclass(frozen=True)
class ClaimedDelivery:
    """A delivery that a service has to attempt now.

    due_score: distinguishes this claim from earlier and later ones.
    trace: the traceparent of the job.
    """

    delivery: Delivery
    url: str
    tenant: str
    due_score: str
    trace: str | None = None


class Deliveries(Protocol):
    """Every method is atomic, and may be repeated when its answer was lost; all raise UnavailableError."""

    def claim_delivery(self, token: str, skipped: Collection[str] = ()) -> ClaimedDelivery | None:
        """Claim the delivery that has been due for longest, for DELIVERY_LEASE_S; None if none is due.

        A delivery that cannot be read is given up, and logged once.

        token: identifies this call; the same token gets the same delivery again. skipped: tenants to skip for now.
        """
        ...

    def record_try(self, claim: ClaimedDelivery, delivery: Delivery, wait_s: float | None) -> bool:
        """Store the result of a claim: the delivery with one more attempt. False if the claim has expired.

        wait_s: seconds until it is due again; None: it is finished.
        """
        ...

    def send_again(self, record: JobRecord) -> None:
        """Make the delivery about a job's last end due now, whatever its status, and reset its count of attempts.

        Nothing changes during an attempt, or if the job has been removed or queued again meanwhile.

        record: the record of a job that has ended and has a callback.
        """
        ...

    def deliveries(self, job_id: str) -> list[Delivery]:
        """The deliveries of a job, one per end, oldest first; empty without a callback. Skips what cannot be read.

        A claimed delivery has no next_try_at_s.
        """
        ...


def delivery_of(document: str) -> Delivery | None:
    """The delivery in a document of the queue; None if it cannot be read, such as one that a later version wrote."""
    try:
        return Delivery.model_validate_json(document)
    except ValueError:
        return None
