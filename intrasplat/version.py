"""The installed version of intrasplat."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version


@cache
def version() -> str:
    """The version of the installed distribution; "0+unknown" in a tree that was not installed."""
    try:
        return installed_version("intrasplat")
    except PackageNotFoundError:
        return "0+unknown"
