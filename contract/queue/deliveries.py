"""The part of the queue that remembers which webhooks are owed (`Deliveries`, a Protocol).

A job's end and the delivery that it owes are one step, so neither a killed worker nor a killed service loses one.
Services lend deliveries that are due. A loan is a lease: if nothing is noted before it runs out, another service is
lent the delivery. So each is made at least once, and twice only if a service died, or lost the queue, in between.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

from contract.wire.job import JobRecord
from contract.wire.webhooks import Delivery

LOAN_S = 30.0
"""Longer than a try takes (service/webhooks.py)."""


OWED_FOR_S = 26 * 3600.0
"""A webhook that the queue has lost is owed again, unless its job ended longer ago than tries usually go on."""


@dataclass(frozen=True)
class Loan:
    """A delivery that a service is to try now; `mark` tells this loan from earlier and later ones."""

    delivery: Delivery
    url: str
    tenant: str
    mark: str
    trace: str | None = None
    """The traceparent of the job."""


class Deliveries(Protocol):
    """Every method is atomic, and may be repeated when its answer was lost; all raise UnavailableError."""

    def lend_delivery(self, token: str, passed: Collection[str] = ()) -> Loan | None:
        """The delivery that has been due for longest, which is lent to nobody else for LOAN_S; None if none is due.

        What cannot be read is given up, and logged once.

        token: of this call; the same token gets the same delivery again. passed: tenants whose deliveries have to wait.
        """
        ...

    def note_try(self, loan: Loan, delivery: Delivery, wait_s: float | None) -> bool:
        """Keep what became of a loan: the delivery with one more try. False if the loan no longer holds.

        wait_s: until it is due again; None: it is owed no more.
        """
        ...

    def send_again(self, record: JobRecord) -> None:
        """Make the delivery about a job's last end due now, whatever became of it, with its tries forgiven.

        It stays as it is while a try is under way, and if the job has gone or gone on meanwhile.

        record: of a job that has ended and has a callback.
        """
        ...

    def deliveries(self, job_id: str) -> list[Delivery]:
        """What a job's ends owe and owed, the first end first, without what cannot be read; nothing without a callback.

        While one is lent, it has no next_try_at_s.
        """
        ...


def delivery_of(document: str) -> Delivery | None:
    """The delivery in a document of the queue; None if it cannot be read, as one of a later version."""
    try:
        return Delivery.model_validate_json(document)
    except ValueError:
        return None
