"""Client: one blocking method a route, typed answers, errors as exceptions (errors.py)."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import httpx
from typing_extensions import Unpack

from intrasplat_client.connection import DEFAULT_URL, BlockingConnection, http_settings, iterate, run
from intrasplat_client.core import SCORES_WITHIN_S, Core
from intrasplat_client.models import Delivery, GivenOptions, JobState, JobView, Measurement, Report, SceneCameras
from intrasplat_client.session import DEFAULT_PATIENCE_S, OnWait
from intrasplat_client.submission import OnUpload
from intrasplat_client.viewer import StreamMessages, Viewer
from intrasplat_client.views import Image

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Client:
    """A connection to one service: use it as a context, or call close().

    api_key: from `intrasplat keys create`; needed unless the service runs on this machine for its user alone.
    patience_s: how long, in all, a call waits while the service is busy (429, 503) or the connection is lost. Where
    nobody answers at all, a call fails at once.
    on_wait(error, pause_s): is called before each of these waits.
    transport: instead of the network, for tests.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        api_key: str | None = None,
        patience_s: float = DEFAULT_PATIENCE_S,
        on_wait: OnWait | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._http = httpx.Client(transport=transport, **http_settings(self.url, api_key))
        self._api_key = api_key
        self._core = Core(BlockingConnection(self._http), self.url, patience_s, on_wait)

    def reconstruct(
        self,
        clip: Path | None = None,
        right: Path | None = None,
        *,
        clip_of: str | None = None,
        calibration: Path | None = None,
        masks: Path | None = None,
        label: str | None = None,
        metadata: Mapping[str, str] | None = None,
        callback_url: str | None = None,
        idempotency_key: str | None = None,
        in_pieces: bool | None = None,
        on_upload: OnUpload | None = None,
        **options: Unpack[GivenOptions],
    ) -> JobView:
        """Upload a clip and get its queued job; `right` is the right eye's file, if there are two.

        `clip_of`, instead of a clip, is the id of a job or scene whose clip is used again, with its calibration and
        masks unless others are given here: so better masks need no second upload of the clip.
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
        return run(
            self._core.reconstruct(
                clip,
                right,
                clip_of=clip_of,
                calibration=calibration,
                masks=masks,
                label=label,
                metadata=metadata,
                callback_url=callback_url,
                idempotency_key=idempotency_key,
                in_pieces=in_pieces,
                on_upload=on_upload,
                **options,
            )
        )

    def import_scene(
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
        return run(
            self._core.import_scene(
                path,
                label=label,
                metadata=metadata,
                callback_url=callback_url,
                retention_hours=retention_hours,
                idempotency_key=idempotency_key,
                on_upload=on_upload,
            )
        )

    def job(self, job_id: str) -> JobView:
        """A job's state and progress."""
        return run(self._core.job(job_id))

    def jobs(
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
        metadata: what theirs must have. preset: only those of it. created_from_s, created_until_s: UNIX s.
        """
        return run(
            self._core.jobs(
                state,
                limit,
                q=q,
                metadata=metadata,
                preset=preset,
                created_from_s=created_from_s,
                created_until_s=created_until_s,
            )
        )

    def label(self, job_id: str, label: str | None = None, metadata: Mapping[str, str] | None = None) -> JobView:
        """Change a job's label, or its metadata as a whole; "" and {} remove them, what is not given stays."""
        return run(self._core.label(job_id, label, metadata))

    def deliveries(self, job_id: str) -> list[Delivery]:
        """The webhooks about the ends of a job that has a callback_url, with every try to deliver them."""
        return run(self._core.deliveries(job_id))

    def send_again(self, job_id: str) -> list[Delivery]:
        """Have the webhook about a job's last end sent now, whatever became of it; then as deliveries()."""
        return run(self._core.send_again(job_id))

    def cancel(self, job_id: str) -> JobView:
        """Cancel a job; a running one stops a moment later."""
        return run(self._core.cancel(job_id))

    def retry(self, job_id: str) -> JobView:
        """Queue a failed job again."""
        return run(self._core.retry(job_id))

    def watch(self, job_id: str) -> Generator[JobView, None, None]:
        """The job whenever something happens to it, the last time in its terminal state."""
        return iterate(self._core.watch(job_id))

    def wait(self, job_id: str, on_progress: Callable[[JobView], object] | None = None) -> JobView:
        """The job, once it is done; on_progress(job) is called whenever something happens to it.

        Raises:
            JobRejected, JobFailed, JobCancelled: it ended without a scene.
        """
        return run(self._core.wait(job_id, on_progress))

    def render(
        self,
        t: float = 0.0,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        format: str = "png",
        quality: int | None = None,
        unseen: str | None = None,
        highlights: str | None = None,
        known: Image | None = None,
        **camera: float,
    ) -> Image:
        """One view of a finished scene, or of a job that trains; arguments as Core.render has them."""
        return run(
            self._core.render(
                t,
                scene=scene,
                pose=pose,
                layer=layer,
                format=format,
                quality=quality,
                unseen=unseen,
                highlights=highlights,
                known=known,
                **camera,
            )
        )

    def render_array(
        self,
        t: float = 0.0,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        unseen: str | None = None,
        highlights: str | None = None,
        **camera: float,
    ) -> NDArray[Any]:
        """One view's exact values: uint8 [H, W, 3] of rgb, float32 [H, W] of depth (mm, 0 invalid) and confidence.

        unseen as render has it: marked, rgb shows the hatch, and depth and confidence are 0. highlights: as there.

        Raises:
            ImportError: numpy is not installed.
        """
        return run(
            self._core.render_array(
                t, scene=scene, pose=pose, layer=layer, unseen=unseen, highlights=highlights, **camera
            )
        )

    def stream(self, scene: str) -> Viewer:
        """A connection for many views: `with client.stream(scene) as viewer: viewer.render(t, pose)`."""
        return Viewer(StreamMessages(self.url, scene, self._api_key))

    def scenes(
        self,
        limit: int | None = None,
        *,
        q: str | None = None,
        metadata: Mapping[str, str] | None = None,
        preset: str | None = None,
        created_from_s: float | None = None,
        created_until_s: float | None = None,
    ) -> list[dict[str, Any]]:
        """Finished scenes, newest first: at most `limit`, 200 if it is not given. The rest as `jobs` has it."""
        return run(
            self._core.scenes(
                limit,
                q=q,
                metadata=metadata,
                preset=preset,
                created_from_s=created_from_s,
                created_until_s=created_until_s,
            )
        )

    def report(self, scene: str, scores_within_s: float = SCORES_WITHIN_S) -> Report:
        """The scene's quality report. Waits at most so long for its scores, which follow a job's end within seconds."""
        return run(self._core.report(scene, scores_within_s))

    def curve(self, scene: str) -> str:
        """Held-out psnr_tissue over seconds of training, as CSV."""
        return run(self._core.curve(scene))

    def masks(self, scene: str) -> bytes:
        """The masks that were found, as a zip to correct and to send with the clip again."""
        return run(self._core.masks(scene))

    def thumbnail(self, scene: str) -> bytes:
        """A small JPEG of a finished scene's first moment."""
        return run(self._core.thumbnail(scene))

    def recorded(self, scene: str, t: float = 0.0, eye: str = "left", masks: str = "marked") -> bytes:
        """The recorded frame nearest to t as JPEG, with the masked parts marked; also while the job trains.

        `masks="off"` marks nothing; `masks="only"` is the mask, a PNG. `report(scene).recorded` lists the frames.
        """
        return run(self._core.recorded(scene, t, eye, masks))

    def cameras(self, scene: str) -> SceneCameras:
        """Where the endoscope was, frame by frame, and its lens; also while the job trains."""
        return run(self._core.cameras(scene))

    def measure(
        self,
        scene: str,
        points: Sequence[tuple[float, float]],
        t: float = 0.0,
        pose: str | None = None,
        **camera: float,
    ) -> Measurement:
        """Depth, place and uncertainty in mm under points (x, y) of a view; of two points their distance over time.

        A point with a `refusal` was not measured. Arguments as Core.measure has them.
        """
        return run(self._core.measure(scene, points, t, pose, **camera))

    def export(self, scene: str, t: float | None = None, format: str = "ply", **options: float | str) -> bytes:
        """The scene as a file of a format; docs/export.md lists the formats and their options."""
        return run(self._core.export(scene, t, format, **options))

    def file(self, scene: str, name: str = "scene.safetensors") -> bytes:
        """A stored file of the scene: manifest.json, or one that it lists. Needs the scope download."""
        return run(self._core.file(scene, name))

    def delete(self, scene: str) -> dict[str, Any]:
        """Remove clip, scene and record of a job that has ended; the receipt lists what was removed."""
        return run(self._core.delete(scene))

    def key(self) -> dict[str, Any]:
        """Tenant, scopes and id of the key that is used."""
        return run(self._core.key())

    def info(self) -> dict[str, Any]:
        """Version, limits and accepted formats of the service."""
        return run(self._core.info())

    def is_ready(self) -> bool:
        """Whether the service would train a clip sent now; False too while nobody answers."""
        return run(self._core.is_ready())

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
