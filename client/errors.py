"""What can go wrong between a caller and a service.

IntrasplatError (contract/errors.py)
├── InputError
│   ├── RequestRefused    the service refused the request: status, field, remedy
│   └── JobRejected       the job failed because of what was sent
├── UnavailableError      the service, its queue or its worker cannot be reached
├── JobFailed             the job failed for another reason
├── Cancelled
│   └── JobCancelled      somebody cancelled the job
└── ServiceFault          the service answered with a fault of its own
"""

from __future__ import annotations

from contract.errors import Cancelled, InputError, IntrasplatError
from contract.job import JobView


class RequestRefused(InputError):
    """The service refused the request; `status` is HTTP's."""

    def __init__(self, status: int, field: str, problem: str, remedy: str) -> None:
        super().__init__(field, problem, remedy)
        self.status = status


class ServiceFault(IntrasplatError):
    """The service answered, but not with anything that was asked for."""


class JobRejected(InputError):
    """The job failed because its input cannot be used; `job` is its last view."""

    def __init__(self, job: JobView, field: str, problem: str, remedy: str) -> None:
        super().__init__(field, problem, remedy)
        self.job = job


class JobFailed(IntrasplatError):
    """The job failed for a reason other than its input; `job` is its last view."""

    def __init__(self, job: JobView) -> None:
        error = job.error
        super().__init__(" ".join(part for part in (error.problem, error.remedy) if part) if error else "It failed.")
        self.job = job


class JobCancelled(Cancelled):
    """The job was cancelled; `job` is its last view."""

    def __init__(self, job: JobView) -> None:
        super().__init__(f"Job {job.id} was cancelled.")
        self.job = job
