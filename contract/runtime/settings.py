"""What a deployment may set, read once from the environment: every process of one installation sees the same values."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from contract.wire.errors import InputError
from contract.wire.names import DeviceName

GIB = 2**30
ENVIRONMENT_PREFIX = "INTRASPLAT_"
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""A service at one of these is reached from this machine alone."""


def default_data_dir() -> Path:
    """Where clips and scenes live unless told otherwise: the XDG state directory of this user."""
    state_home = os.environ.get("XDG_STATE_HOME")
    return (Path(state_home) if state_home else Path.home() / ".local" / "state") / "intrasplat"


def _listed(value: object) -> object:
    """A list from its comma-separated text."""
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def _value(source: Mapping[str, str], variable: str) -> str:
    """What a variable holds, or the file that its namesake with _FILE names; empty if neither is set."""
    path = source.get(f"{variable}_FILE")
    if source.get(variable) or not path:
        return source.get(variable, "")
    try:
        return Path(path).read_text().strip()
    except (OSError, UnicodeError) as error:
        problem = f"{path} cannot be read ({type(error).__name__})."
        raise InputError(f"{variable}_FILE", problem, "Name a text file that this user may read.") from error


class Settings(BaseModel):
    """Each field `name` is read from `INTRASPLAT_NAME`; the queue's address alone has the customary name REDIS_URL.

    A variable with _FILE after its name (REDIS_URL_FILE) names a file that holds the value: for secrets.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    data_dir: Path = Field(default_factory=default_data_dir)
    redis_url: str | None = None
    """None: `intrasplat up` starts its own Valkey and hands its address to the processes it starts."""
    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=1, le=65535)
    dashboard_dir: Path | None = None
    worker_name: str = Field(default="worker-1", pattern=r"^[A-Za-z0-9-]{1,40}$")
    device: DeviceName = "auto"
    log_format: Literal["text", "json"] = "text"

    # what is accepted
    max_upload_bytes: int = Field(default=4 * GIB, gt=0)
    max_frames: int = Field(default=1000, gt=0)
    max_frame_pixels: int = Field(default=4096 * 2160, gt=0)
    """Of one eye."""
    max_clip_s: float = Field(default=600.0, gt=0)
    min_free_bytes: int = Field(default=2 * GIB, ge=0)
    """An upload is refused while the data directory's disk has less than this left."""
    max_uploads: int = Field(default=8, gt=0)
    """Received at the same time, of all callers."""
    upload_silence_s: float = Field(default=60.0, gt=0)
    """A request body that brings nothing for so long is given up."""
    max_queued: int = Field(default=200, gt=0)
    max_queued_per_tenant: int = Field(default=50, gt=0)
    requests_per_s: float = Field(default=400.0, gt=0)
    """Of one key, or of one address where no key is asked for; each process of the service counts for itself."""

    # who may come in
    hosts: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Names besides loopback and `host` that requests may be addressed to."""
    cors_origins: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Origins of pages from elsewhere that may use the service; none by default."""

    # how long things are kept
    retention_hours: float | None = Field(default=None, gt=0)
    """Of jobs that do not say themselves; None keeps them until they are deleted."""
    max_retention_hours: float | None = Field(default=None, gt=0)

    # renders
    max_render_pixels: int = Field(default=4096 * 2160, gt=0)
    render_timeout_s: float = Field(default=20.0, gt=0)
    render_endpoint: str | None = Field(default=None, pattern=r"^tcp://[^\s]+:\d+$")
    """Where the worker answers services on other machines, as they reach it; needs render_secret. None: a socket."""
    render_secret: str | None = Field(default=None, min_length=32)
    """Shared by services and workers; the keys of the encrypted connection between them are made from it."""
    hot_bytes: int = Field(default=2 * GIB, gt=0)
    """Scenes a worker keeps in memory, together."""

    # many machines
    store_url: str | None = Field(default=None, pattern=r"^s3://[^\s]+$")
    """Where clips and scenes are kept for all machines; None: in data_dir."""

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Settings:
        """Read the settings from environment variables; empty ones count as unset.

        Raises:
            InputError: a variable holds a value its setting does not accept, or names a file that cannot be read.
        """
        source = os.environ if environment is None else environment
        variables = {name: ENVIRONMENT_PREFIX + name.upper() for name in cls.model_fields}
        values = {name: _value(source, variable) for name, variable in variables.items()}
        values["redis_url"] = _value(source, "REDIS_URL") or values["redis_url"]
        values = {name: value for name, value in values.items() if value}
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            variable = ENVIRONMENT_PREFIX + str(first["loc"][0]).upper()
            problem = f"{first['input']!r} is not accepted: {first['msg']}."
            raise InputError(variable, problem, f"Correct or unset {variable}.") from error

    def to_environment(self) -> dict[str, str]:
        """The variables that make another process read these very settings."""
        values = {
            ENVIRONMENT_PREFIX + name.upper(): ",".join(value) if isinstance(value, tuple) else str(value)
            for name, value in self
            if value is not None and name != "redis_url"
        }
        return values | ({"REDIS_URL": self.redis_url} if self.redis_url else {})
