"""What a client does, told apart from how it is done, so that the blocking and the asynchronous one share all of it.

A procedure is a generator: it yields a step, is given what came of it, and in the end returns its result. Client and
AsyncClient (client/api.py, client/async_api.py) only take the steps; no module below them touches a connection.

    step        is answered with
    Call        the response, read          Unreachable is thrown in where the connection fails
    Pause       nothing, later
    Listen      the response; read, unless it is a stream of events
    NextLine    the next line of what is listened to; None at its end
    Show        nothing; the value goes to whoever iterates
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeAlias, TypeVar

import httpx

from client.errors import Refusal, ServiceFault, ServiceUnavailable, Unreachable, error_of_answer
from contract.wire.errors import IntrasplatError
from contract.wire.job import JobView

DEFAULT_PATIENCE_S = 30.0
FIRST_PAUSE_S = 0.25
LONGEST_PAUSE_S = 8.0

Result = TypeVar("Result")


@dataclass(frozen=True)
class Body:
    """What a request sends: its length, its bytes piece by piece, and whom to tell how many of them have gone."""

    length_bytes: int
    pieces: Callable[[], Iterator[bytes]]
    on_sent: Callable[[int], None] = lambda _: None


@dataclass(frozen=True)
class Call:
    """A request. is_repeatable: it may be sent again when its answer was lost."""

    method: str
    path: str
    query: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: Any = None
    body: Body | None = None
    is_repeatable: bool = False


@dataclass(frozen=True)
class Pause:
    """Wait."""

    seconds: float


@dataclass(frozen=True)
class Listen:
    """Send a request and keep its answer open; what was listened to before is let go."""

    call: Call


@dataclass(frozen=True)
class NextLine:
    """Wait for a line."""


@dataclass(frozen=True)
class Show:
    """Give a job's view to whoever iterates."""

    job: JobView


Step: TypeAlias = Call | Pause | Listen | NextLine | Show
Steps: TypeAlias = Generator[Step, Any, Result]


class Procedure(Generic[Result]):
    """A procedure under way: `step` is to be taken, then answer() or fail() is called; None once there is a result."""

    def __init__(self, steps: Steps[Result]) -> None:
        self._steps = steps
        self.result: Result
        self.step: Step | None = None
        self._advance(lambda: next(steps))

    def answer(self, reply: Any) -> None:
        """What came of the step.

        Raises:
            ServiceFault: it cannot be read. A procedure reads nothing but replies, so that is what these errors mean.
        """
        try:
            self._advance(lambda: self._steps.send(reply))
        except (ValueError, KeyError, TypeError) as error:
            status = reply.status_code if isinstance(reply, httpx.Response) else httpx.codes.OK
            problem = "What answers there is no intrasplat service, or one of another version."
            raise ServiceFault(Refusal(status, problem, remedy="Correct the address.")) from error

    def fail(self, error: Unreachable) -> None:
        """The step could not be taken."""
        self._advance(lambda: self._steps.throw(error))

    def _advance(self, move: Callable[[], Step]) -> None:
        try:
            self.step = move()
        except StopIteration as end:
            self.step, self.result = None, end.value


class Patience:
    """Pauses that double, until together they are longer than `total_s` without any success in between."""

    def __init__(self, total_s: float) -> None:
        self._total_s = total_s
        self.renew()

    def renew(self) -> None:
        """Something went well."""
        self._left_s, self._next_s = self._total_s, FIRST_PAUSE_S

    def pause(self, failure: IntrasplatError) -> Pause:
        """How long to wait after a failure, at least as long as it asks for; raises it once patience is used up."""
        asked_s = failure.retry_after_s if isinstance(failure, ServiceUnavailable) else None
        pause_s = max(self._next_s, asked_s or 0.0)
        if pause_s > self._left_s:
            raise failure
        self._left_s -= pause_s
        self._next_s = min(2 * self._next_s, LONGEST_PAUSE_S)
        return Pause(pause_s)


def error_of(response: httpx.Response) -> IntrasplatError:
    """The exception that a response means which is no success."""
    return error_of_answer(response.status_code, response.headers, response.content)


def answered(call: Call, patience_s: float) -> Steps[httpx.Response]:
    """Send a call, again while the service is busy (429, 503) or loses the connection; its response.

    Raises:
        Unreachable: nobody is there, at once; or the connection was lost and the call may not be repeated, or was.
        ServiceUnavailable, RateLimited: the service stayed busy.
        RequestRefused, ServiceFault: it answered otherwise.
    """
    patience, is_there = Patience(patience_s), False
    while True:
        failure: IntrasplatError
        try:
            response: httpx.Response = yield call
        except Unreachable as error:
            if (error.is_nobody_there and not is_there) or not call.is_repeatable:
                raise
            failure = error
        else:
            if response.is_success or response.status_code == httpx.codes.NOT_MODIFIED:
                return response
            failure = error_of(response)
            # A job in the answer means that there is nothing to send again.
            if not isinstance(failure, ServiceUnavailable) or failure.job_id is not None:
                raise failure
        is_there = True
        yield patience.pause(failure)
