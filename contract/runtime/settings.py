"""The settings of a deployment, read from the environment. All processes of an installation use the same values."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator
from pydantic_core.core_schema import ValidationInfo

from contract.runtime.queue_url import parse_queue_url
from intrasplat.errors import InputError
from intrasplat.intake.limits import EYES, ClipLimits
from intrasplat.live.spec import MAX_KEEP_S, parsed
from intrasplat.names import DeviceName

GIB = 2**30
ENVIRONMENT_PREFIX = "INTRASPLAT_"
OTHER_VARIABLES = frozenset({"API_KEY", "CACHE", "CHAOS_FOLDER", "DATA", "LAST_WORDS", "THREADS", "URL"})
"""INTRASPLAT_ variables that are not settings: commands, tests and processes use them."""
MISSPELT = 0.75
"""From this similarity on, in [0, 1], a variable's name counts as a misspelt setting."""
WEBHOOK_HOST_PATTERN = r"(https?://)?([A-Za-z0-9.-]+|\[[0-9A-Fa-f:]+\])(:[0-9]{1,5})?"
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""Only this machine can reach a service at one of these."""


def default_data_dir() -> Path:
    """The default folder of clips and scenes: the XDG state directory of this user."""
    state_home = os.environ.get("XDG_STATE_HOME")
    return (Path(state_home) if state_home else Path.home() / ".local" / "state") / "intrasplat"


def _listed(value: object) -> object:
    """The parts of a comma-separated text."""
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def _value(source: Mapping[str, str], variable: str) -> str:
    """The value of a variable, or the content of the file that <variable>_FILE names; empty if neither is set."""
    path = source.get(f"{variable}_FILE")
    if source.get(variable) or not path:
        return source.get(variable, "")
    try:
        return Path(path).read_text().strip()
    except (OSError, UnicodeError) as error:
        problem = f"{path} cannot be read ({type(error).__name__})."
        raise InputError(f"{variable}_FILE", problem, "Name a text file that this user may read.") from error


def _check_names(source: Mapping[str, str], fields: Collection[str]) -> None:
    """Raise if a variable looks like a misspelt setting. Others are ignored, because Kubernetes adds some of its own.

    Raises:
        InputError: names the first such variable and the likely setting.
    """
    known = [name.upper() for name in fields]
    settings = {*known, *(f"{name}_FILE" for name in known), *OTHER_VARIABLES}
    for variable in sorted(source):
        name = variable.removeprefix(ENVIRONMENT_PREFIX)
        if name == variable or name in settings or not source[variable]:
            continue
        if near := get_close_matches(name, known, 1, MISSPELT):
            remedy = f"Did you mean {ENVIRONMENT_PREFIX}{near[0]}? Else unset it."
            raise InputError(variable, "there is no such setting.", remedy)


class Settings(BaseModel):
    """The settings. Each field `name` is read from `INTRASPLAT_NAME`, only redis_url from the customary REDIS_URL.

    For secrets, a variable with _FILE after its name (REDIS_URL_FILE) names a file that holds the value. Fields with
    repr=False are secrets: neither an error nor the text of Settings shows them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    data_dir: Path = Field(default_factory=default_data_dir)
    redis_url: str | None = Field(default=None, repr=False)
    """None: `intrasplat up` starts its own Valkey and hands its address to the processes it starts."""
    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=1, le=65535)
    dashboard_dir: Path | None = None
    worker_name: str = Field(default="worker-1", pattern=r"^[A-Za-z0-9-]{1,40}$")
    device: DeviceName = "auto"
    segmenter: Path | None = None
    """An ONNX file with which a worker finds the instruments of clips without masks; needs the extra `onnx`."""
    log_format: Literal["text", "json"] = "text"

    # what is accepted
    max_upload_bytes: int = Field(default=4 * GIB, gt=0)
    max_frames: int = Field(default=1000, gt=0)
    max_frame_pixels: int = Field(default=4096 * 2160, gt=0)
    """Maximum pixels of one eye's frame."""
    max_clip_s: float = Field(default=600.0, gt=0)
    min_free_bytes: int = Field(default=2 * GIB, ge=0)
    """The service refuses uploads while the data directory's disk has less room than this."""
    max_uploads: int = Field(default=8, gt=0)
    """Maximum uploads received at the same time, from all callers."""
    upload_silence_s: float = Field(default=60.0, gt=0)
    """The service drops a request whose body brings nothing for this long."""
    max_queued: int = Field(default=200, gt=0)
    max_queued_per_tenant: int = Field(default=50, gt=0)
    tenant_share: float = Field(default=0.5, gt=0, le=1)
    """Share of max_uploads, and of the disk's room, that the uploads of one tenant may hold; its first always may."""
    long_training_s: float = Field(default=600.0, gt=0)
    """Only keys with the scope `long` may ask for longer trainings."""
    requests_per_s: float = Field(default=400.0, gt=0)
    """Maximum rate of one key, or of one address without a key; each process of the service counts for itself."""

    # who may come in
    hosts: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Names besides loopback and `host` that a request's Host header may hold."""
    cors_origins: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Origins of pages on other hosts that may use the service; none by default."""

    # how long things are kept
    retention_hours: float | None = Field(default=None, gt=0)
    """For jobs that name no retention themselves; None keeps them until they are deleted."""
    max_retention_hours: float | None = Field(default=None, gt=0)

    # webhooks
    webhook_secret: str | None = Field(default=None, min_length=32, repr=False)
    """The secrets that tenants verify webhooks with are made from it."""
    webhook_old_secret: str | None = Field(default=None, min_length=32, repr=False)
    """The one before it: while it is set, webhooks are signed with both."""
    webhook_hosts: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Where webhooks may go: HOST or HOST:PORT for https, http://HOST:PORT without encryption; nowhere by default."""
    webhook_private: Literal["no", "yes"] = "no"
    """yes: those hosts may have private addresses, and those of this machine."""

    # live feeds
    feeds: int = Field(default=1, ge=0)
    """Feeds that a worker follows at the same time."""
    max_feeds: int = Field(default=8, ge=0)
    """Open feeds of all callers."""
    feeds_of_tenant: int = Field(default=4, ge=0)
    feed_hosts: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Where feeds may be read from, such as rtsp://camera.example.org or udp://0.0.0.0:5000; nowhere by default."""
    feed_private: Literal["no", "yes"] = "no"
    """yes: those hosts may have private addresses, and those of this machine."""
    feed_devices: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()
    """Capture devices and files of the worker's machine that feeds may be read from, as absolute paths."""
    feed_keep_s: float = Field(default=3600.0, gt=0, le=MAX_KEEP_S)
    """Longest past of a feed."""
    feed_disk_bytes: int = Field(default=8 * GIB, gt=0)
    """Most bytes of one feed: half for its recording, half for the past of its model; the oldest go first."""

    # renders
    max_render_pixels: int = Field(default=4096 * 2160, gt=0)
    render_timeout_s: float = Field(default=20.0, gt=0)
    render_endpoint: str | None = Field(default=None, pattern=r"^tcp://[^\s]+:\d+$")
    """The address at which services on other machines reach the worker; needs render_secret. None: a unix socket."""
    render_secret: str | None = Field(default=None, min_length=32, repr=False)
    """Shared by services and workers, which make the keys of their encrypted connection from it."""
    hot_bytes: int = Field(default=2 * GIB, gt=0)
    """Maximum bytes of all scenes that a worker keeps in memory."""

    # many machines
    store_url: str | None = Field(default=None, pattern=r"^s3://[^\s]+$")
    """The bucket that keeps clips and scenes for all machines; None: data_dir keeps them."""

    @property
    def clip_limits(self) -> ClipLimits:
        """The limits of clips. A picture may hold two eyes of max_frame_pixels."""
        return ClipLimits(self.max_frames, self.max_clip_s, EYES * self.max_frame_pixels)

    @field_validator("webhook_hosts")
    @classmethod
    def _origins(cls, hosts: tuple[str, ...], given: ValidationInfo) -> tuple[str, ...]:
        for host in hosts:
            if not re.fullmatch(WEBHOOK_HOST_PATTERN, host, re.ASCII):
                raise ValueError(f"{host!r} is not HOST, HOST:PORT or http://HOST:PORT")
        if hosts and not given.data.get("webhook_secret"):
            raise ValueError(f"webhooks are signed; set {ENVIRONMENT_PREFIX}WEBHOOK_SECRET (openssl rand -hex 32), too")
        return hosts

    @field_validator("feed_hosts")
    @classmethod
    def _sources(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            try:
                is_host = parsed(host).host != ""
            except InputError as error:
                raise ValueError(f"{error.problem} It takes SCHEME://HOST, with the port of tcp and udp") from None
            if not is_host:
                raise ValueError(f"{host!r} is not SCHEME://HOST or SCHEME://HOST:PORT")
        return hosts

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Settings:
        """Read the settings from environment variables; empty ones count as unset.

        Raises:
            InputError: a variable holds a value that its setting does not accept, names a file that cannot be read, or
                looks like a misspelt setting.
        """
        source = os.environ if environment is None else environment
        _check_names(source, cls.model_fields)
        variables = {name: ENVIRONMENT_PREFIX + name.upper() for name in cls.model_fields}
        values = {name: _value(source, variable) for name, variable in variables.items()}
        values["redis_url"] = _value(source, "REDIS_URL") or values["redis_url"]
        values = {name: value for name, value in values.items() if value}
        if "redis_url" in values:
            parse_queue_url(values["redis_url"])
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            name = str(first["loc"][0])
            variable = ENVIRONMENT_PREFIX + name.upper()
            shown = repr(first["input"]) if cls.model_fields[name].repr else "its value"
            problem = f"{shown} is not accepted: {first['msg']}."
            raise InputError(variable, problem, f"Correct or unset {variable}.") from error

    def to_environment(self) -> dict[str, str]:
        """The variables from which another process reads the same settings."""
        values = {
            ENVIRONMENT_PREFIX + name.upper(): ",".join(value) if isinstance(value, tuple) else str(value)
            for name, value in self
            if value is not None and name != "redis_url"
        }
        return values | ({"REDIS_URL": self.redis_url} if self.redis_url else {})
