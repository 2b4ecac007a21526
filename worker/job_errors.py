"""Describe an error to the caller of a job.

The text of an unforeseen error may contain names of a caller's files, so neither the caller nor the log gets it.
"""

from __future__ import annotations

import logging

from contract.wire.job import JobError
from intrasplat.errors import ErrorCode, InputError, IntrasplatError, UnavailableError
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS

FAULT_REMEDY = "This is a fault of intrasplat: please report it with the worker's log."

logger = logging.getLogger("intrasplat.worker")


def describe(error: Exception) -> JobError:
    """Problem and remedy of an error; for an unforeseen error only its type."""
    if isinstance(error, InputError):
        return JobError(code=error.code, problem=error.problem, field=error.field, remedy=error.remedy)
    if isinstance(error, UnavailableError):
        return JobError(code=error.code, problem=error.problem, remedy=error.remedy)
    if isinstance(error, IntrasplatError):
        return JobError(code=error.code, problem=str(error), remedy="The worker's log has the details.")
    if isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS:
        remedy = "Free space on its disk, and retry the job."
        return JobError(code=ErrorCode.STORE_FULL, problem="The worker's disk is full.", remedy=remedy)
    # Recognise torch.OutOfMemoryError by its name, because the supervisor does not load torch.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        remedy = "Send a shorter or smaller clip."
        return JobError(code=ErrorCode.OUT_OF_MEMORY, problem="The worker ran out of memory.", remedy=remedy)
    logger.error("a fault while a job ran", exc_info=error)
    problem = f"A fault in the worker ({type(error).__name__})."
    return JobError(code=ErrorCode.FAULT, problem=problem, remedy=FAULT_REMEDY)
