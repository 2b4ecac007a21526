"""What a scene can be saved as, as the API lists it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.formats import VideoView


class ExportOffer(BaseModel):
    """A format of GET /scenes/{id}/export for one scene, and whether this installation can make it."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: str
    about: str
    file_name: str = Field(description="after the scene's label; what the export's Content-Disposition says, too")
    media_type: str
    options: list[str] = Field(description="the options that fit")
    views: list[VideoView] = Field(default=[], description="of a video: the views that this scene has")
    needs: str | None = Field(
        default=None, description="what must be installed where the worker runs before it can be made; null: nothing"
    )
