"""Every error that intrasplat raises on purpose.

    IntrasplatError
    ├── InputError            the user's input cannot be used: names the field and the remedy
    │   ├── LimitError        the input is larger than this machine accepts
    │   ├── NotListedError    the user's source is none of those that whoever runs the service has listed
    │   ├── MissingExtraError what is asked for needs an extra that is not installed
    │   └── ResumeMismatch    the folder holds a stopped run that this request does not continue
    ├── TrainingDiverged      the optimiser left the finite numbers, or the model collapsed
    ├── SceneError            a stored scene is missing, damaged or of another version
    ├── Cancelled             the caller asked to stop
    └── UnavailableError      a required queue, device or binary is missing

Each has a code for programs (docs/codes.md) and one sentence for people. InputError and UnavailableError also say what
to do.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar


class ErrorCode(StrEnum):
    """The kind of an error, for programs; docs/codes.md explains each."""

    ATTEMPTS_EXHAUSTED = "attempts_exhausted"
    CANCELLED = "cancelled"
    FAULT = "fault"
    INPUT = "input"
    KEY_EXPIRED = "key_expired"
    LIMIT = "limit"
    MISSING_EXTRA = "missing_extra"
    NOT_LISTED = "not_listed"
    NOT_YET = "not_yet"
    OUT_OF_MEMORY = "out_of_memory"
    FEEDS_FULL = "feeds_full"
    QUEUE_FULL = "queue_full"
    RECORD_UNREADABLE = "record_unreadable"
    RESUME_MISMATCH = "resume_mismatch"
    SCENE = "scene"
    STORE_FULL = "store_full"
    DECODER_KILLED = "decoder_killed"
    TRAINING_DIVERGED = "training_diverged"
    UNAVAILABLE = "unavailable"
    UNCLASSIFIED = "unclassified"


class IntrasplatError(Exception):
    """Base of all errors raised on purpose."""

    code: ClassVar[ErrorCode] = ErrorCode.UNCLASSIFIED


class InputError(IntrasplatError):
    """The input cannot be used as it is.

    Attributes:
        field: the input that is wrong, as the caller names it ("clip", "calibration", "masks", "options.holdout").
        problem: what is wrong with it, with the offending value.
        remedy: what to do about it, one sentence.
    """

    code = ErrorCode.INPUT

    def __init__(self, field: str, problem: str, remedy: str) -> None:
        super().__init__(f"{field}: {problem} {remedy}")
        self.field = field
        self.problem = problem
        self.remedy = remedy


class LimitError(InputError):
    """The input is larger than this machine accepts (frames, pixels, bytes, seconds)."""

    code = ErrorCode.LIMIT


class NotListedError(InputError):
    """A source that whoever runs the service has not listed."""

    code = ErrorCode.NOT_LISTED


class MissingExtraError(InputError):
    """What is asked for needs an optional part of intrasplat that is not installed; the remedy names it."""

    code = ErrorCode.MISSING_EXTRA


class ResumeMismatch(InputError):
    """The folder holds a stopped run that is damaged, of another version, or of another request."""

    code = ErrorCode.RESUME_MISMATCH


class TrainingDiverged(IntrasplatError):
    """Training reached a NaN or lost its Gaussians, or a render contains a NaN."""

    code = ErrorCode.TRAINING_DIVERGED


class SceneError(IntrasplatError):
    """A stored scene is missing, damaged (hash mismatch) or written by another version."""

    code = ErrorCode.SCENE


class Cancelled(IntrasplatError):
    """The caller asked to stop."""

    code = ErrorCode.CANCELLED


class UnavailableError(IntrasplatError):
    """Something this command needs is not on this machine.

    Attributes:
        remedy: one line that says how to fix it.
        may_return: it may return by itself, like a queue on another machine that starts later.
    """

    code = ErrorCode.UNAVAILABLE

    def __init__(self, problem: str, remedy: str, *, may_return: bool = False) -> None:
        super().__init__(f"{problem} {remedy}")
        self.problem = problem
        self.remedy = remedy
        self.may_return = may_return
