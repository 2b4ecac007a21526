"""Rendered views: their parameters, and their answers over HTTP or over the stream."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import httpx

from intrasplat_client.connection import Call
from intrasplat_client.errors import InputError, IntrasplatError, Refusal, ServiceFault, error_of_document
from intrasplat_client.session import Session, parsed

if TYPE_CHECKING:
    from numpy.typing import NDArray

NPY = "application/x-npy"
LENGTH_BYTES = 4
"""Size of the number at the start of a stream message: the length of its head."""


@dataclass(frozen=True)
class PictureCamera:
    """Where a picture was taken from and through which lens, in pixels of that picture.

    world_from_camera: the upper three rows, row-major, translation in mm.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: tuple[float, ...]

    @classmethod
    def of_document(cls, document: Mapping[str, Any] | None) -> PictureCamera | None:
        """The camera in the service's JSON; None: the service is too old to send it."""
        if document is None:
            return None
        known = {each.name: document[each.name] for each in fields(cls)}
        return cls(**{**known, "world_from_camera": tuple(document["world_from_camera"])})


@dataclass(frozen=True)
class Image:
    """A rendered view: the encoded file, and what it shows.

    state is "running" for a view of a job that still trains; iteration is then the step of the snapshot. unseen is the
    share of the view that no training frame saw, detail that of its tissue whose detail comes from recorded frames, and
    camera the picture's; None: the service is too old to send them. Of a live feed, state is the feed's, captured_at is
    when the moment's pair arrived (RFC 3339), age_s the seconds from then until the answer, and source_s the moment in
    seconds of the source; None of a scene.
    warning_codes are those of docs/codes.md, and warning their texts; they say nothing of the scene itself, as its
    report does.
    """

    content: bytes
    media_type: str
    scene: str
    t: float
    state: str = "done"
    iteration: int | None = None
    unseen: float | None = None
    detail: float | None = None
    warning: str | None = None
    warning_codes: tuple[str, ...] = ()
    etag: str | None = None
    render_ms: float | None = None
    camera: PictureCamera | None = None
    captured_at: str | None = None
    age_s: float | None = None
    source_s: float | None = None

    def array(self) -> NDArray[Any]:
        """The values of a view requested with format="npy".

        Raises:
            InputError: the view has another format.
            ImportError: numpy is not installed.
        """
        if self.media_type != NPY:
            raise InputError("format", f"this render is {self.media_type}.", 'Ask for it with format="npy".')
        try:
            import numpy as np  # only this method needs it
        except ImportError as error:
            raise ImportError("Arrays need numpy: pip install 'intrasplat-client[numpy]'.") from error

        values: NDArray[Any] = np.load(io.BytesIO(self.content), allow_pickle=False)
        return values


def view_query(
    t: float | str | None,
    scene: str | None,
    pose: str | None,
    layer: str,
    format: str,
    quality: int | None,
    unseen: str | None,
    highlights: str | None,
    light: str | None,
    smoke: str | None,
    detail: str | None,
    camera: Mapping[str, float],
) -> dict[str, Any]:
    """The parameters of a view for GET /render and for messages of the stream."""
    values = {"t": t, "scene": scene, "pose": pose, "layer": layer, "format": format, "quality": quality}
    shown = {"unseen": unseen, "highlights": highlights, "light": light, "smoke": smoke, "detail": detail}
    return {name: value for name, value in {**values, **shown, **camera}.items() if value is not None}


async def render(session: Session, query: Mapping[str, Any], known: Image | None) -> Image:
    """One view; `known` itself if it is still up to date."""
    headers = {"If-None-Match": known.etag} if known is not None and known.etag is not None else {}
    response = await session.request(Call("GET", "/render", query, headers, is_repeatable=True))
    if response.status_code == httpx.codes.NOT_MODIFIED and known is not None:
        return known
    return parsed(response, _image_of, response)


def _image_of(response: httpx.Response) -> Image:
    about = {name.removeprefix("x-intrasplat-"): value for name, value in response.headers.items()}
    return Image(
        content=response.content,
        media_type=about["content-type"],
        scene=about["scene"],
        t=float(about["t"]),
        state=about["state"],
        iteration=int(about["iteration"]) if "iteration" in about else None,
        unseen=float(about["unseen"]) if "unseen" in about else None,
        detail=float(about["detail"]) if "detail" in about else None,
        warning=about.get("warning"),
        warning_codes=tuple(filter(None, about.get("warning-codes", "").split(", "))),
        etag=about.get("etag"),
        render_ms=_duration_ms(about.get("server-timing", ""), "render"),
        camera=PictureCamera.of_document(json.loads(about.get("camera", "null"))),
        captured_at=about.get("captured-at"),
        age_s=float(about["age-s"]) if "age-s" in about else None,
        source_s=float(about["source-s"]) if "source-s" in about else None,
    )


def _duration_ms(server_timing: str, name: str) -> float | None:
    """`render` of "render;dur=3.1, total;dur=4.0"."""
    for entry in server_timing.split(","):
        metric, _, duration = entry.strip().partition(";dur=")
        if metric == name and duration:
            return float(duration)
    return None


def image_of_message(message: bytes | str) -> tuple[object, Image | IntrasplatError]:
    """The request's id, and the view or the error in an answer of the stream."""
    try:
        if isinstance(message, str):
            document = json.loads(message)
            return document.get("id"), error_of_document(document)
        end = LENGTH_BYTES + int.from_bytes(message[:LENGTH_BYTES], "big")
        head = json.loads(message[LENGTH_BYTES:end])
        image = Image(
            content=message[end:],
            media_type=head["media_type"],
            scene=head["scene"],
            t=head["t"],
            state=head["state"],
            iteration=head["iteration"],
            unseen=head.get("unseen"),
            detail=head.get("detail"),
            warning="; ".join(each["text"] for each in head["warnings"]) or None,
            warning_codes=tuple(each["code"] for each in head["warnings"]),
            render_ms=head["render_ms"],
            camera=PictureCamera.of_document(head.get("camera")),
            captured_at=head.get("captured_at"),
            age_s=head.get("age_s"),
            source_s=head.get("source_s"),
        )
        return head["id"], image
    except (ValueError, KeyError, TypeError, AttributeError):
        return None, ServiceFault(Refusal(200, "The service sent a message that is not a view."))
