"""The methods of both clients, written once: AsyncClient inherits them, and Client wraps each of them (client.py)."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import httpx
from pydantic import TypeAdapter
from typing_extensions import Unpack

from intrasplat_client import events, models, submission, views
from intrasplat_client.connection import Call, Connection
from intrasplat_client.errors import Unreachable
from intrasplat_client.feeds import FeedCalls
from intrasplat_client.models import Delivery, GivenOptions, JobState, JobView, Measurement, Report, SceneCameras
from intrasplat_client.session import OnWait, Session, parsed
from intrasplat_client.submission import OnUpload
from intrasplat_client.views import Image, view_query

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCORES_WITHIN_S, LOOK_PERIOD_S = 30.0, 0.3
"""How long report() waits for scores, and how often it asks. Another scene may have to be scored first."""

MAX_PAGE = 200
NEXT_HEADER = "X-Intrasplat-Next"
"""The cursor of the next page of a list."""


class Core(FeedCalls):
    """Every route of a service as a coroutine."""

    def __init__(self, connection: Connection, url: str, patience_s: float, on_wait: OnWait | None = None) -> None:
        self.url = url
        self._session = Session(connection, url, patience_s, on_wait)

    async def reconstruct(
        self,
        clip: Path | None = None,
        right: Path | None = None,
        *,
        clip_of: str | None = None,
        calibration: Path | None = None,
        masks: Path | None = None,
        poses_file: Path | None = None,
        fov_mask: Path | None = None,
        label: str | None = None,
        metadata: Mapping[str, str] | None = None,
        callback_url: str | None = None,
        idempotency_key: str | None = None,
        in_pieces: bool | None = None,
        on_upload: OnUpload | None = None,
        **options: Unpack[GivenOptions],
    ) -> JobView:
        """Upload a clip and get its queued job; `right` is the right eye's file, if there are two.

        `clip_of`, instead of a clip, is the id of a job or scene whose clip is used again, with its other files unless
        others are given here: so better masks need no second upload of the clip.
        `poses_file` holds the camera's poses: TUM, or a matrix a frame as JSON or text.
        `fov_mask` is a PNG of the field of view, white inside, of the recorded left eye or of both eyes side by side.
        A large clip is sent in pieces, and its upload resumes where a lost connection cut it off; `in_pieces` forces
        or forbids that. on_upload(sent_bytes, total_bytes) is called while the clip is sent. The same idempotency_key
        with the same clip and options always yields the same job, also later and from another process.
        `label` and `metadata` are texts to find the job by; write no names of persons into them.
        `callback_url` is where the service sends a webhook when the job has ended; its host must be allowed there.
        `options` say how to reconstruct: preset, budget_s or iterations, holdout and others (GivenOptions).

        Raises:
            InputError: a file cannot be read, there is no clip or both clip and clip_of, or an option cannot be used;
                nothing was sent.
        """
        others = {"calibration": calibration, "masks": masks, "poses_file": poses_file, "fov_mask": fov_mask}
        prepared = submission.prepare(
            clip,
            right,
            submission.texts_of(clip_of=clip_of, callback_url=callback_url),
            others,
            options,
            submission.labels_of(label, metadata),
            idempotency_key=idempotency_key,
            in_pieces=in_pieces,
            on_upload=on_upload,
        )
        return await submission.submit(self._session, prepared)

    async def import_scene(
        self,
        path: Path,
        *,
        label: str | None = None,
        metadata: Mapping[str, str] | None = None,
        callback_url: str | None = None,
        retention_hours: float | None = None,
        idempotency_key: str | None = None,
        on_upload: OnUpload | None = None,
    ) -> JobView:
        """Import a scene that another installation exported with format="scene", and get its queued job.

        The job is done when a worker has read the scene; its id is the scene's here. The same idempotency_key with the
        same file always yields the same job. label, metadata, callback_url, on_upload: as reconstruct has them.

        Raises:
            InputError: the file cannot be read; nothing was sent.
        """
        prepared = submission.prepare_scene(
            Path(path),
            retention_hours,
            submission.texts_of(callback_url=callback_url),
            submission.labels_of(label, metadata),
            idempotency_key=idempotency_key,
            on_upload=on_upload,
        )
        return await submission.submit(self._session, prepared)

    async def job(self, job_id: str) -> JobView:
        """A job's state and progress."""
        return await self._job(Call("GET", _path("jobs", job_id), is_repeatable=True))

    async def jobs(
        self,
        state: JobState | None = None,
        limit: int | None = None,
        *,
        q: str | None = None,
        metadata: Mapping[str, str] | None = None,
        preset: str | None = None,
        created_from_s: float | None = None,
        created_until_s: float | None = None,
    ) -> list[JobView]:
        """The newest jobs, newest first: at most `limit`, 200 if it is not given.

        state: only those in it. q: words, each part of the label or of a value of metadata, or the beginning of the id.
        metadata: entries that the job's metadata must have. preset: only jobs with it. created_from_s,
        created_until_s: UNIX s.
        """
        chosen = None if state is None else JobState(state).value
        search = _search(q, metadata, preset, created_from_s, created_until_s)
        found = await self._pages("jobs", limit, {"state": chosen, **search})
        return [JobView.model_validate(job) for job in found]

    async def label(self, job_id: str, label: str | None = None, metadata: Mapping[str, str] | None = None) -> JobView:
        """Change a job's label, or its metadata as a whole; "" and {} remove them, what is not given stays."""
        change = submission.labels_of(label, metadata)
        return await self._job(Call("PATCH", _path("jobs", job_id), json=change, is_repeatable=True))

    async def deliveries(self, job_id: str) -> list[Delivery]:
        """The webhooks about the ends of a job that has a callback_url, with every try to deliver them."""
        response = await self._session.request(Call("GET", _path("jobs", job_id, "deliveries"), is_repeatable=True))
        return parsed(response, TypeAdapter(list[Delivery]).validate_json, response.content)

    async def send_again(self, job_id: str) -> list[Delivery]:
        """Have the webhook about a job's last end sent now, whatever its status. Returns as deliveries()."""
        response = await self._session.request(Call("POST", _path("jobs", job_id, "deliveries")))
        return parsed(response, TypeAdapter(list[Delivery]).validate_json, response.content)

    async def cancel(self, job_id: str) -> JobView:
        """Cancel a job; a running one stops a moment later."""
        return await self._job(Call("DELETE", _path("jobs", job_id), is_repeatable=True))

    async def retry(self, job_id: str) -> JobView:
        """Queue a failed job again."""
        return await self._job(Call("POST", _path("jobs", job_id, "retry")))

    def watch(self, job_id: str) -> AsyncGenerator[JobView, None]:
        """The job whenever something happens to it, the last time in its terminal state."""
        return events.watch(self._session, _path("jobs", job_id))

    async def wait(self, job_id: str, on_progress: Callable[[JobView], object] | None = None) -> JobView:
        """The job, once it is done; on_progress(job) is called whenever something happens to it.

        Raises:
            JobRejected, JobFailed, JobCancelled: it ended without a scene.
        """
        async for job in self.watch(job_id):
            if on_progress is not None:
                on_progress(job)
        return events.finished(job)

    async def render(
        self,
        /,
        t: float | str | None = None,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        format: str = "png",
        quality: int | None = None,
        unseen: str | None = None,
        highlights: str | None = None,
        light: str | None = None,
        smoke: str | None = None,
        detail: str | None = None,
        known: Image | None = None,
        **camera: float,
    ) -> Image:
        """One view of a finished scene, of a job that trains, or of a live feed.

        t: time as a fraction of the clip, in [0, 1]; of a live feed "live" (the default), seconds before that (-12.5),
            seconds of the source, or a time of RFC 3339.
        scene: the job's or feed's id; needed unless the service holds one scene only.
        pose: orbit:YAW,PITCH,ZOOM in degrees, orbit:YAW,PITCH,ZOOM,X,Y,Z with the point looked at in mm, or
            world_from_camera as 12 or 16 numbers in mm, row-major.
        layer: rgb, depth, confidence, smoke or error. format: png, jpeg, webp or npy. quality: 1 to 100.
        unseen: mark (the default) hatches what no training frame saw, and makes it transparent in png and webp; guess
            shows what the model draws there.
        highlights: off shows rgb without the highlights that were separated by comparing both eyes of a stereo clip; a
            scene of one eye has none and is shown as it is. on is the default.
        light: steady (the default) shows rgb in the light of one frame, recorded in that of the moment; they differ
            where exposure or white balance change in the clip, or its border is dark.
        smoke: remove (the default) shows rgb without the smoke that was found before the tissue, show with it.
        detail: on (the default) adds what the model misses of the recorded frames nearest in time, off does not.
        known: an earlier view; it is returned if it is still what the service would send.
        camera: width, height, fx, fy, cx, cy in pixels; near_mm, far_mm: ends of the false colours of depth.
        """
        query = view_query(t, scene, pose, layer, format, quality, unseen, highlights, light, smoke, detail, camera)
        return await views.render(self._session, query, known)

    async def render_array(
        self,
        /,
        t: float | str | None = None,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        unseen: str | None = None,
        highlights: str | None = None,
        light: str | None = None,
        smoke: str | None = None,
        detail: str | None = None,
        **camera: float,
    ) -> NDArray[Any]:
        """One view's exact values: uint8 [H, W, 3] of rgb, float32 [H, W] of depth (mm, 0 invalid) and confidence.

        unseen as render has it: marked, rgb shows the hatch, and depth and confidence 0. highlights, light,
        smoke, detail: as there.

        Raises:
            ImportError: numpy is not installed.
        """
        query = view_query(t, scene, pose, layer, "npy", None, unseen, highlights, light, smoke, detail, camera)
        return (await views.render(self._session, query, None)).array()

    async def scenes(
        self,
        limit: int | None = None,
        *,
        q: str | None = None,
        metadata: Mapping[str, str] | None = None,
        preset: str | None = None,
        created_from_s: float | None = None,
        created_until_s: float | None = None,
    ) -> list[dict[str, Any]]:
        """Finished scenes, newest first: at most `limit`, 200 if it is not given. Other arguments as in jobs()."""
        return await self._pages("scenes", limit, _search(q, metadata, preset, created_from_s, created_until_s))

    async def report(self, scene: str, scores_within_s: float = SCORES_WITHIN_S) -> Report:
        """The scene's quality report. Waits at most scores_within_s for its scores, which follow within seconds.

        `scored` is False in a report without them.
        """
        until_s = time.monotonic() + scores_within_s
        while True:
            response = await self._get("scenes", scene)
            report = parsed(response, Report.model_validate_json, response.content)
            if report.scored or time.monotonic() > until_s:
                return report
            await self._session.sleep(LOOK_PERIOD_S)

    async def curve(self, scene: str) -> str:
        """Held-out psnr_tissue over seconds of training, as CSV."""
        return (await self._get("scenes", scene, "curve")).content.decode()

    async def masks(self, scene: str) -> bytes:
        """The masks that were found, as a zip to correct and to send with the clip again."""
        return (await self._get("scenes", scene, "masks")).content

    async def thumbnail(self, scene: str) -> bytes:
        """A small JPEG of a finished scene's first moment."""
        return (await self._get("scenes", scene, "thumbnail")).content

    async def recorded(
        self, scene: str, t: float | str | None = None, eye: str = "left", masks: str = "marked"
    ) -> bytes:
        """The recorded frame nearest to t as JPEG, with the masked parts marked; also while the job trains.

        `masks="off"` marks nothing; `masks="only"` is the mask, a PNG. `report(scene).recorded` lists the frames.
        """
        return (await self._get("scenes", scene, "recorded", t=t, eye=eye, masks=masks)).content

    async def cameras(self, scene: str) -> SceneCameras:
        """The endoscope's pose in each frame, and its lens; also while the job trains."""
        response = await self._get("scenes", scene, "cameras")
        return parsed(response, SceneCameras.model_validate_json, response.content)

    async def measure(
        self,
        /,
        scene: str,
        points: Sequence[tuple[float, float]],
        t: float | str | None = None,
        pose: str | None = None,
        shape: str | None = None,
        **camera: float,
    ) -> Measurement:
        """Depth, place and uncertainty in mm under points (x, y) of a view; of two points their distance over time.

        shape: "line", "area" or "angle", what the points make together, over time: see MeasuredShape.
        pose and camera (width, height, fx, fy, cx, cy) as render has them: the points are pixels of that picture. A
        point with a `refusal` was not measured.
        """
        asked = ";".join(f"{float(x)!r},{float(y)!r}" for x, y in points)
        response = await self._get("scenes", scene, "measure", points=asked, t=t, pose=pose, shape=shape, **camera)
        return parsed(response, Measurement.model_validate_json, response.content)

    async def export(
        self, /, scene: str, t: float | str | None = None, format: str = "ply", **options: float | str
    ) -> bytes:
        """Export the scene to a file format; docs/export.md lists the formats and their options."""
        return (await self._get("scenes", scene, "export", t=t, format=format, **options)).content

    async def exports(self, scene: str) -> list[models.ExportOffer]:
        """The formats of export() for this scene, and what the service lacks for some of them (`needs`)."""
        response = await self._get("scenes", scene, "exports")
        return parsed(response, TypeAdapter(list[models.ExportOffer]).validate_json, response.content)

    async def file(self, scene: str, name: str = "scene.safetensors") -> bytes:
        """A stored file of the scene: manifest.json, or one that it lists. Needs the scope download."""
        return (await self._get("scenes", scene, "files", name)).content

    async def delete(self, scene: str) -> dict[str, Any]:
        """Remove clip, scene and record of a job that has ended; the receipt lists what was removed."""
        # Not repeatable: if its answer is lost, the next one would be that there is no such scene.
        receipt: dict[str, Any] = _json_of(await self._session.request(Call("DELETE", _path("scenes", scene))))
        return receipt

    async def key(self) -> dict[str, Any]:
        """Tenant, scopes and id of the key that is used."""
        key: dict[str, Any] = _json_of(await self._get("key"))
        return key

    async def info(self) -> dict[str, Any]:
        """Version, limits and accepted formats of the service."""
        info: dict[str, Any] = _json_of(await self._get("info"))
        return info

    async def is_ready(self) -> bool:
        """Whether the service would train a clip sent now; False if it does not answer."""
        try:
            return (await self._session.send(Call("GET", "/readyz"))).status_code == httpx.codes.OK
        except Unreachable:
            return False

    async def _get(self, *path: str, **query: Any) -> httpx.Response:
        given = {name: value for name, value in query.items() if value is not None}
        return await self._session.request(Call("GET", _path(*path), given, is_repeatable=True))

    async def _pages(self, path: str, limit: int | None, search: Mapping[str, Any]) -> list[Any]:
        """The first `limit` entries of a list, read page by page."""
        left, cursor = limit or MAX_PAGE, None
        found: list[Any] = []
        while left > 0:
            response = await self._get(path, limit=min(left, MAX_PAGE), cursor=cursor, **search)
            page: list[Any] = _json_of(response)
            found += page
            left -= len(page)
            cursor = response.headers.get(NEXT_HEADER)
            if cursor is None:
                break
        return found

    async def _job(self, call: Call) -> JobView:
        response = await self._session.request(call)
        return parsed(response, JobView.model_validate_json, response.content)


def _json_of(response: httpx.Response) -> Any:
    return parsed(response, json.loads, response.content)


def _search(
    q: str | None, metadata: Mapping[str, str] | None, preset: str | None, from_s: float | None, until_s: float | None
) -> dict[str, Any]:
    """The query of a list, with None for unused conditions."""
    wanted = [f"{name}={value}" for name, value in (metadata or {}).items()]
    dates = {"created_from_s": from_s, "created_until_s": until_s}
    return {"q": q, "metadata": wanted or None, "preset": preset, **dates}


def _path(*parts: str) -> str:
    return "".join(f"/{quote(part, safe='')}" for part in parts)
