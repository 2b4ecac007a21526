"""A client for the commands. It raises the errors of intrasplat/errors.py, and its remedies name commands.

The service's remedies name routes. The error's type and the refused command determine which command to name instead;
the service's words never do.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from types import MappingProxyType
from typing import TypeAlias

import intrasplat_client
from intrasplat.errors import Cancelled, InputError, IntrasplatError, UnavailableError
from intrasplat_client import Client
from intrasplat_client.session import DEFAULT_PATIENCE_S

KEY_VARIABLE = "INTRASPLAT_API_KEY"

Remedies: TypeAlias = Mapping[type[intrasplat_client.IntrasplatError], str]

REMEDIES: Remedies = MappingProxyType(
    {
        intrasplat_client.Unauthorized: f"Give one as --api-key or {KEY_VARIABLE}.",
        intrasplat_client.NotFound: "`intrasplat jobs` lists what there is.",
    }
)
"""Remedies by error, for every command; a command may have its own."""


@contextmanager
def connected(url: str, api_key: str | None = None, remedies: Remedies | None = None) -> Iterator[Client]:
    """A client of the service at `url`. remedies: what to say instead of the service's remedy, by the error's type.

    Raises:
        InputError, UnavailableError, Cancelled, IntrasplatError: in place of the client's errors.
    """
    try:
        with Client(url, api_key=api_key, on_wait=_Waiting().report) as client:
            yield client
    except intrasplat_client.IntrasplatError as error:
        raise command_error(error, {**REMEDIES, **(remedies or {})}) from error


class _Waiting:
    """Prints once why a command waits."""

    def __init__(self) -> None:
        self._is_reported = False

    def report(self, failure: intrasplat_client.IntrasplatError, pause_s: float) -> None:
        if not self._is_reported:
            self._is_reported = True
            again = f"Asking again for up to {DEFAULT_PATIENCE_S:g} s."
            print(f"intrasplat: {getattr(failure, 'problem', failure)} {again}", file=sys.stderr, flush=True)


def command_error(error: intrasplat_client.IntrasplatError, remedies: Remedies = REMEDIES) -> IntrasplatError:
    """The equivalent error of the command line."""
    match error:
        case intrasplat_client.RequestRefused(status=HTTPStatus.INSUFFICIENT_STORAGE):
            return InputError(
                error.field, error.problem, "Delete scenes (`intrasplat delete JOB`) or give it more room."
            )
        case intrasplat_client.InputError():
            return InputError(error.field, error.problem, remedies.get(type(error), error.remedy))
        case intrasplat_client.ServiceUnavailable(job_id=str(job_id)):
            return UnavailableError(error.problem, f"Send nothing again; `intrasplat watch {job_id}` shows it later.")
        case intrasplat_client.ServiceUnavailable():
            return UnavailableError(error.problem, error.remedy)
        case intrasplat_client.JobCancelled():
            return Cancelled(str(error))
    return IntrasplatError(str(error))
