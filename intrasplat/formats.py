"""The export formats of a stored scene: their names, file names and options, and the check of the options.

intrasplat/export writes the formats; docs/export.md lists their units, axes and readers.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.util import find_spec
from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from intrasplat.errors import InputError, MissingExtraError
from intrasplat.names import Keep

VideoView = Literal["endoscope", "orbit", "rock", "stereo"]
MAX_RECORDED_BYTES = 16_000_000
"""Recorded frames of at most so many bytes are put into a page by default. With a scene of a few megabytes, the page is
then about as large as mail servers take."""
FORMAT_REMEDY = "docs/export.md lists the formats and their options."


class ExportOptions(BaseModel):
    """What a caller may choose about an export. EXPORT_FORMATS says which options fit which format."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    exclusive: ClassVar[tuple[str, ...]] = ()
    """Options of which at most one may be given."""

    t: float | None = Field(
        default=None,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        description="the moment: 0 is the first frame, 1 the end of the clip (default: 0)",
    )
    every: int | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="for formats over time: export one of so many frames (default: 1, all)",
    )
    view: VideoView | None = Field(
        default=None,
        description="for a video: endoscope: as it saw the clip; orbit: circling about it; rock: turning to and fro; "
        "these two of one moment if t is given; stereo: both eyes side by side (default: endoscope)",
    )
    baseline_mm: float | None = Field(
        default=None,
        gt=0,
        le=50,
        allow_inf_nan=False,
        description="distance of the eyes of view=stereo in mm (default: the endoscope's own)",
    )
    recorded: Keep | None = Field(
        default=None,
        description="for a page, the recorded frames, which show the patient's tissue and the instruments: on: put "
        f"them in; off: leave them out (default: on if they have at most {MAX_RECORDED_BYTES // 10**6} MB)",
    )

    def given(self) -> dict[str, object]:
        """The options that the caller chose, by name."""
        return self.model_dump(exclude_none=True)


@dataclass(frozen=True)
class ExportFormat:
    """An export format: the suffix of its file name, its media type, and the options that fit."""

    suffix: str
    media_type: str
    options: tuple[str, ...]
    about: str
    is_stored: bool = False
    """Whether the service itself writes it from the stored files, for keys that may download them."""
    extra: str | None = None
    """The extra of intrasplat that whoever writes it needs; of EXTRA_MODULES."""


_VIDEO = ("view", "every", "t", "baseline_mm")
_BYTES = "application/octet-stream"
EXPORT_FORMATS = {
    "ply": ExportFormat(".ply", _BYTES, ("t",), "the Gaussians at time t as splat viewers read them, mm"),
    "ply-zip": ExportFormat("-ply.zip", "application/zip", ("every",), "a ply for each frame, in a zip"),
    "splat": ExportFormat(".splat", _BYTES, ("t",), "the Gaussians at time t in 32 bytes each, mm"),
    "gltf": ExportFormat(
        ".glb",
        "model/gltf-binary",
        ("t",),
        "the Gaussians at time t as glTF splats, metres, +Y up",
    ),
    "points": ExportFormat("-points.ply", _BYTES, ("t",), "the Gaussians' centres at time t as coloured points, mm"),
    "mesh-stl": ExportFormat(
        "-mesh.stl", "model/stl", ("t",), "the surface at time t as STL without colours, mm", extra="mesh"
    ),
    "mesh-ply": ExportFormat("-mesh.ply", _BYTES, ("t",), "the surface at time t as a coloured mesh, mm", extra="mesh"),
    "mesh-glb": ExportFormat(
        "-mesh.glb",
        "model/gltf-binary",
        ("t",),
        "the surface at time t as glTF, coloured, metres, +Y up",
        extra="mesh",
    ),
    "depth": ExportFormat("-depth.npy", _BYTES, ("every",), "depth of each frame, [T, H, W] float32 mm"),
    "tracks": ExportFormat("-tracks.npz", "application/zip", ("every",), "where each Gaussian is over time, mm"),
    "webm": ExportFormat(".webm", "video/webm", _VIDEO, "a video without instruments (VP8)"),
    "mp4": ExportFormat(".mp4", "video/mp4", _VIDEO, "a video without instruments (H.264; else VP9)"),
    "html": ExportFormat(
        ".html",
        "text/html",
        ("recorded",),
        "a page with player, scene and recorded frames that opens from a disk",
        is_stored=True,
    ),
    "scene": ExportFormat(
        ".scene.zip", "application/zip", (), "the scene itself, to be imported elsewhere", is_stored=True
    ),
    "tum": ExportFormat(".tum", "text/plain", (), "the endoscope's path as a TUM file, seconds and metres"),
}
"""The formats by name."""

EXTRA_MODULES = {"mesh": "skimage"}
"""A module of each extra that formats need, by which its installation is known."""


@cache
def missing_extras() -> tuple[str, ...]:
    """The extras of EXTRA_MODULES that are not installed here."""
    return tuple(extra for extra, module in EXTRA_MODULES.items() if find_spec(module) is None)


def requirement(extra: str) -> str:
    """What pip installs for an extra."""
    return f"intrasplat[{extra}]"


def check_extra(name: str, missing: Collection[str]) -> None:
    """Raise MissingExtraError if the format needs an extra that is missing."""
    known = EXPORT_FORMATS.get(name)
    if known is not None and known.extra is not None and known.extra in missing:
        problem = f"This installation cannot make {name} files: it lacks {requirement(known.extra)}."
        raise MissingExtraError("format", problem, f"pip install '{requirement(known.extra)}' where its worker runs.")


_OF_VIEWS = {"t": ("orbit", "rock"), "baseline_mm": ("stereo",)}
"""Options of a video that fit only some of its views."""


def check_export(name: str, given: Mapping[str, object]) -> ExportOptions:
    """The options of an export, checked against its format; None means not given.

    Raises:
        InputError: there is no such format, an option does not fit it, or a value is out of its range.
    """
    export_format = EXPORT_FORMATS.get(name)
    if export_format is None:
        near = get_close_matches(name, EXPORT_FORMATS, 1, 0.5)
        remedy = f"Did you mean {near[0]}?" if near else f"Use one of: {', '.join(EXPORT_FORMATS)}."
        raise InputError("format", f"{name[:40]!r} is not an export format.", remedy)
    chosen = {key: value for key, value in given.items() if value is not None}
    for option in chosen:
        if option not in export_format.options:
            takes = f"It takes {' and '.join(export_format.options)}." if export_format.options else "It takes none."
            remedy = f"Leave it out. {takes}"
            raise InputError(option, f"{option} does not fit the format {name}: {export_format.about}.", remedy)
    for option, views in _OF_VIEWS.items():
        if option in chosen and "view" in export_format.options and chosen.get("view") not in views:
            problem = f"{option} is for view={' and view='.join(views)} alone."
            raise InputError(option, problem, f"Leave it out, or add view={views[0]}.")
    if "t" in chosen and "every" in chosen:
        raise InputError("every", "With t one moment is shown, and every frame is of it.", "Leave out every or t.")
    try:
        return ExportOptions.model_validate(chosen)
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{str(first['input'])[:80]!r} is not accepted: {first['msg']}."
        raise InputError(str(first["loc"][0]), problem, FORMAT_REMEDY) from error
