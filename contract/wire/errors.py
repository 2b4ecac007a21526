"""Every error intrasplat raises on purpose.

    IntrasplatError
    ├── InputError            what the user gave cannot be used: names the field and the remedy
    │   └── LimitError        it is larger than this machine accepts
    ├── TrainingDiverged      the optimiser left the finite numbers, or the model collapsed
    ├── SceneError            a stored scene is missing, damaged or of another version
    ├── Cancelled             the caller asked to stop
    └── UnavailableError      a queue, device or binary that is needed is not there

All carry one sentence that says what is wrong; InputError and UnavailableError also say what to do about it.
"""

from __future__ import annotations


class IntrasplatError(Exception):
    """Base of all errors raised on purpose."""


class InputError(IntrasplatError):
    """The input cannot be used as it is.

    Attributes:
        field: the input that is at fault, in the caller's words ("clip", "calibration", "masks", "options.holdout").
        problem: what is wrong with it, with the offending value.
        remedy: what to do about it, one sentence.
    """

    def __init__(self, field: str, problem: str, remedy: str) -> None:
        super().__init__(f"{field}: {problem} {remedy}")
        self.field = field
        self.problem = problem
        self.remedy = remedy


class LimitError(InputError):
    """The input is larger than this machine accepts (frames, pixels, bytes, seconds)."""


class TrainingDiverged(IntrasplatError):
    """Training reached a NaN or lost its Gaussians; nothing is published."""


class SceneError(IntrasplatError):
    """A stored scene is missing, damaged (hash mismatch) or written by another version."""


class Cancelled(IntrasplatError):
    """The caller asked to stop; nothing is published."""


class UnavailableError(IntrasplatError):
    """Something this command needs is not on this machine.

    Attributes:
        remedy: one line that mends it.
        may_return: it may be there again without anything done here, like a queue on another machine that starts later.
    """

    def __init__(self, problem: str, remedy: str, *, may_return: bool = False) -> None:
        super().__init__(f"{problem} {remedy}")
        self.problem = problem
        self.remedy = remedy
        self.may_return = may_return
