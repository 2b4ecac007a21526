"""Client: one method a route, typed answers, errors as exceptions (client/errors.py).

What a method does is in client/calls.py, for this client and the asynchronous one (client/async_api.py) alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import httpx

from client.calls import Calls
from client.connection import DEFAULT_URL, LISTENING, arguments_of, settings_of, unreachable
from client.steps import DEFAULT_PATIENCE_S, Body, Call, Listen, NextLine, Pause, Procedure, Result, Show, Step, Steps
from client.submission import OnUpload, prepare
from client.viewer import Talk, Viewer
from client.views import Image, view_query
from client.watching import has_events, settled
from contract.wire.job import JobState, JobView

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Client:
    """A connection to one service. Use it as a context, or call close().

    api_key: from `intrasplat keys create`; needed unless the service runs on this machine for its user alone.
    patience_s: how long, in all, a call waits while the service is busy (429, 503) or the connection is lost.
    Where nobody answers at all, that is said at once.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        api_key: str | None = None,
        patience_s: float = DEFAULT_PATIENCE_S,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._api_key = api_key
        self._calls = Calls(patience_s)
        self._http = httpx.Client(transport=transport, **settings_of(self.url, api_key))

    def reconstruct(
        self,
        clip: Path,
        right: Path | None = None,
        *,
        calibration: Path | None = None,
        masks: Path | None = None,
        idempotency_key: str | None = None,
        in_pieces: bool | None = None,
        on_upload: OnUpload | None = None,
        **options: Any,
    ) -> JobView:
        """Upload a clip (`right`: the right eye's file, if there are two) and get its queued job.

        Large clips go in pieces, and a lost connection is taken up where it was cut off; `in_pieces` says otherwise.
        on_upload(sent_bytes, total_bytes) is called on the way. Whoever gives the same idempotency_key with the same
        clip and options again, also later and from another process, gets the same job.
        `options` are the fields of JobOptions: preset, budget_s or iterations, mask_polarity, layout,
        pose_convention, holdout, seed, priority, retention_hours.
        """
        others = {"calibration": calibration, "masks": masks}
        prepared = prepare(
            clip, right, others, options, idempotency_key=idempotency_key, in_pieces=in_pieces, on_upload=on_upload
        )
        return self._run(self._calls.reconstruct(prepared))

    def job(self, job_id: str) -> JobView:
        """Where a job stands."""
        return self._run(self._calls.job(job_id))

    def jobs(self, state: JobState | None = None, limit: int | None = None) -> list[JobView]:
        """The newest jobs, newest first; of one state, if it is given."""
        return self._run(self._calls.jobs(state, limit))

    def cancel(self, job_id: str) -> JobView:
        """Cancel a job; a running one stops a moment later."""
        return self._run(self._calls.cancel(job_id))

    def retry(self, job_id: str) -> JobView:
        """Queue a failed job again."""
        return self._run(self._calls.retry(job_id))

    def watch(self, job_id: str) -> Iterator[JobView]:
        """The job whenever something happens to it, the last time in its terminal state."""
        return self._follow(self._calls.watch(job_id))

    def wait(self, job_id: str, on_progress: Callable[[JobView], object] | None = None) -> JobView:
        """The job, once it is done.

        Raises:
            JobRejected, JobFailed, JobCancelled: it did not come to a scene.
        """
        for job in self.watch(job_id):
            if on_progress is not None:
                on_progress(job)
        return settled(job)

    def render(
        self,
        t: float = 0.0,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        format: str = "png",
        quality: int | None = None,
        known: Image | None = None,
        **camera: float,
    ) -> Image:
        """One view, of a job that still trains as well. `pose` as the API spells it: orbit:YAW,PITCH,ZOOM in degrees,
        or world_from_camera in mm; `quality` of jpeg and webp, 1 to 100; `camera` may hold width, height, fx, fy, cx,
        cy in pixels. `known`, a view from before, is returned if it still is what would be sent.
        """
        query = view_query(t, scene, pose, layer, format, quality, camera)
        return self._run(self._calls.render(query, known))

    def render_array(
        self, t: float = 0.0, *, scene: str | None = None, pose: str | None = None, layer: str = "rgb", **camera: float
    ) -> NDArray[Any]:
        """One view's exact values: uint8 [H, W, 3] of rgb, float32 [H, W] of depth (mm, 0 invalid) and confidence."""
        query = view_query(t, scene, pose, layer, "npy", None, camera)
        return self._run(self._calls.render(query, None)).array()

    def stream(self, scene: str) -> Viewer:
        """A connection for many views: `with client.stream(scene) as viewer: viewer.render(t, pose)`."""
        return Viewer(Talk(self.url, scene, self._api_key))

    def scenes(self, limit: int | None = None) -> list[dict[str, Any]]:
        """Finished scenes, newest first."""
        return self._run(self._calls.scenes(limit))

    def report(self, scene: str) -> dict[str, Any]:
        """The scene's quality report."""
        return self._run(self._calls.report(scene))

    def curve(self, scene: str) -> str:
        """Held-out psnr_tissue over seconds of training, as CSV."""
        return self._run(self._calls.curve(scene))

    def export(self, scene: str, t: float = 0.0, format: str = "ply") -> bytes:
        """The scene's Gaussians at time t as a file."""
        return self._run(self._calls.export(scene, t, format))

    def delete(self, scene: str) -> dict[str, Any]:
        """Remove clip, scene and record of a job that has ended; the receipt says what was removed."""
        return self._run(self._calls.delete(scene))

    def info(self) -> dict[str, Any]:
        """Version, limits and accepted formats of the service."""
        return self._run(self._calls.info())

    def is_ready(self) -> bool:
        """Whether a clip sent now would be trained; False too while nobody answers."""
        try:
            return self._http.get("/readyz").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self, steps: Steps[Result]) -> Result:
        """Take the steps of a procedure that shows nothing on the way."""
        procedure = Procedure(steps)
        while procedure.step is not None:
            try:
                reply = self._take(procedure.step)
            except httpx.TransportError as error:
                procedure.fail(unreachable(self.url, error))
            else:
                procedure.answer(reply)
        return procedure.result

    def _follow(self, steps: Steps[None]) -> Iterator[JobView]:
        """Take the steps of a procedure that listens, and give what it shows."""
        procedure = Procedure(steps)
        lines: Iterator[str]
        with ExitStack() as connection:
            while procedure.step is not None:
                reply: Any = None
                try:
                    match procedure.step:
                        case Show(job):
                            yield job
                        case Listen(call):
                            connection.close()
                            stream = self._http.stream(**arguments_of(call), timeout=LISTENING)
                            reply = connection.enter_context(stream)
                            if has_events(reply):
                                lines = reply.iter_lines()
                            else:
                                reply.read()
                        case NextLine():
                            reply = next(lines, None)
                        case step:
                            reply = self._take(step)
                except httpx.TransportError as error:
                    procedure.fail(unreachable(self.url, error))
                else:
                    procedure.answer(reply)

    def _take(self, step: Step) -> httpx.Response | None:
        match step:
            case Call():
                content = None if step.body is None else _sending(step.body)
                return self._http.request(**arguments_of(step), content=content)
            case Pause(seconds):
                time.sleep(seconds)
        return None


def _sending(body: Body) -> Iterator[bytes]:
    sent_bytes = 0
    for piece in body.pieces():
        yield piece
        sent_bytes += len(piece)
        body.on_sent(sent_bytes)
