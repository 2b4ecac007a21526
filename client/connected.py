"""A client for the commands: its errors become those of contract/wire/errors.py, which have exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import intrasplat_client
from contract.wire.errors import Cancelled, InputError, IntrasplatError, UnavailableError
from intrasplat_client import Client


@contextmanager
def connected(url: str, api_key: str | None = None) -> Iterator[Client]:
    """A client of the service at `url`.

    Raises:
        InputError, UnavailableError, Cancelled, IntrasplatError: in place of the client's errors.
    """
    try:
        with Client(url, api_key=api_key) as client:
            yield client
    except intrasplat_client.IntrasplatError as error:
        raise command_error(error) from error


def command_error(error: intrasplat_client.IntrasplatError) -> IntrasplatError:
    """The error of the command line that means the same."""
    match error:
        case intrasplat_client.InputError():
            return InputError(error.field, error.problem, error.remedy)
        case intrasplat_client.ServiceUnavailable():
            return UnavailableError(error.problem, error.remedy)
        case intrasplat_client.JobCancelled():
            return Cancelled(str(error))
    return IntrasplatError(str(error))
