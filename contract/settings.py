"""What a deployment may set, read once from the environment: every process of one installation sees the same values."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from contract.errors import InputError

GIB = 2**30
ENVIRONMENT_PREFIX = "INTRASPLAT_"


def default_data_dir() -> Path:
    """Where clips and scenes live unless told otherwise: the XDG state directory of this user."""
    state_home = os.environ.get("XDG_STATE_HOME")
    return (Path(state_home) if state_home else Path.home() / ".local" / "state") / "intrasplat"


class Settings(BaseModel):
    """Each field `name` is read from `INTRASPLAT_NAME`; the queue's address alone has the customary name REDIS_URL."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    data_dir: Path = Field(default_factory=default_data_dir)
    redis_url: str | None = None
    """None: `intrasplat up` starts its own Valkey and hands its address to the processes it starts."""
    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=1, le=65535)
    dashboard_dir: Path | None = None
    worker_name: str = Field(default="worker-1", pattern=r"^[A-Za-z0-9-]{1,40}$")
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda)$")
    max_upload_bytes: int = Field(default=4 * GIB, gt=0)
    min_free_bytes: int = Field(default=2 * GIB, ge=0)
    """An upload is refused while the data directory's disk has less than this left."""
    max_render_pixels: int = Field(default=4096 * 2160, gt=0)
    render_timeout_s: float = Field(default=20.0, gt=0)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Settings:
        """Read the settings from environment variables; empty ones count as unset.

        Raises:
            InputError: a variable holds a value its setting does not accept.
        """
        source = os.environ if environment is None else environment
        values = {
            name: source[ENVIRONMENT_PREFIX + name.upper()]
            for name in cls.model_fields
            if source.get(ENVIRONMENT_PREFIX + name.upper())
        }
        if source.get("REDIS_URL"):
            values["redis_url"] = source["REDIS_URL"]
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
            ENVIRONMENT_PREFIX + name.upper(): str(value)
            for name, value in self
            if value is not None and name != "redis_url"
        }
        return values | ({"REDIS_URL": self.redis_url} if self.redis_url else {})
