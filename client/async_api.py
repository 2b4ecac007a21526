"""AsyncClient: Client (client/api.py) to be awaited, with the same methods and the same steps."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import anyio
import httpx

from client.calls import Calls
from client.connection import DEFAULT_URL, LISTENING, arguments_of, settings_of, unreachable
from client.steps import DEFAULT_PATIENCE_S, Body, Call, Listen, NextLine, Pause, Procedure, Result, Show, Step, Steps
from client.submission import OnUpload, prepare
from client.viewer import AsyncViewer, Talk
from client.views import Image, view_query
from client.watching import has_events, settled
from contract.wire.job import JobState, JobView

if TYPE_CHECKING:
    from numpy.typing import NDArray


class AsyncClient:
    """A connection to one service. Use it as an asynchronous context, or await aclose(). Arguments are Client's."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        api_key: str | None = None,
        patience_s: float = DEFAULT_PATIENCE_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._api_key = api_key
        self._calls = Calls(patience_s)
        self._http = httpx.AsyncClient(transport=transport, **settings_of(self.url, api_key))

    async def reconstruct(
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
        """Upload a clip and get its queued job; arguments as Client.reconstruct has them."""
        others = {"calibration": calibration, "masks": masks}
        prepared = prepare(
            clip, right, others, options, idempotency_key=idempotency_key, in_pieces=in_pieces, on_upload=on_upload
        )
        return await self._run(self._calls.reconstruct(prepared))

    async def job(self, job_id: str) -> JobView:
        """Where a job stands."""
        return await self._run(self._calls.job(job_id))

    async def jobs(self, state: JobState | None = None, limit: int | None = None) -> list[JobView]:
        """The newest jobs, newest first; of one state, if it is given."""
        return await self._run(self._calls.jobs(state, limit))

    async def cancel(self, job_id: str) -> JobView:
        """Cancel a job; a running one stops a moment later."""
        return await self._run(self._calls.cancel(job_id))

    async def retry(self, job_id: str) -> JobView:
        """Queue a failed job again."""
        return await self._run(self._calls.retry(job_id))

    def watch(self, job_id: str) -> AsyncIterator[JobView]:
        """The job whenever something happens to it, the last time in its terminal state."""
        return self._follow(self._calls.watch(job_id))

    async def wait(self, job_id: str, on_progress: Callable[[JobView], object] | None = None) -> JobView:
        """The job, once it is done.

        Raises:
            JobRejected, JobFailed, JobCancelled: it did not come to a scene.
        """
        async for job in self.watch(job_id):
            if on_progress is not None:
                on_progress(job)
        return settled(job)

    async def render(
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
        """One view; arguments as Client.render has them."""
        query = view_query(t, scene, pose, layer, format, quality, camera)
        return await self._run(self._calls.render(query, known))

    async def render_array(
        self, t: float = 0.0, *, scene: str | None = None, pose: str | None = None, layer: str = "rgb", **camera: float
    ) -> NDArray[Any]:
        """One view's exact values: uint8 [H, W, 3] of rgb, float32 [H, W] of depth (mm, 0 invalid) and confidence."""
        query = view_query(t, scene, pose, layer, "npy", None, camera)
        return (await self._run(self._calls.render(query, None))).array()

    def stream(self, scene: str) -> AsyncViewer:
        """A connection for many views: `async with client.stream(scene) as viewer: await viewer.render(t, pose)`."""
        return AsyncViewer(Talk(self.url, scene, self._api_key))

    async def scenes(self, limit: int | None = None) -> list[dict[str, Any]]:
        """Finished scenes, newest first."""
        return await self._run(self._calls.scenes(limit))

    async def report(self, scene: str) -> dict[str, Any]:
        """The scene's quality report."""
        return await self._run(self._calls.report(scene))

    async def curve(self, scene: str) -> str:
        """Held-out psnr_tissue over seconds of training, as CSV."""
        return await self._run(self._calls.curve(scene))

    async def export(self, scene: str, t: float = 0.0, format: str = "ply") -> bytes:
        """The scene's Gaussians at time t as a file."""
        return await self._run(self._calls.export(scene, t, format))

    async def delete(self, scene: str) -> dict[str, Any]:
        """Remove clip, scene and record of a job that has ended; the receipt says what was removed."""
        return await self._run(self._calls.delete(scene))

    async def info(self) -> dict[str, Any]:
        """Version, limits and accepted formats of the service."""
        return await self._run(self._calls.info())

    async def is_ready(self) -> bool:
        """Whether a clip sent now would be trained; False too while nobody answers."""
        try:
            return (await self._http.get("/readyz")).status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    async def aclose(self) -> None:
        """Let go of the connection."""
        await self._http.aclose()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def _run(self, steps: Steps[Result]) -> Result:
        """Take the steps of a procedure that shows nothing on the way."""
        procedure = Procedure(steps)
        while procedure.step is not None:
            try:
                reply = await self._take(procedure.step)
            except httpx.TransportError as error:
                procedure.fail(unreachable(self.url, error))
            else:
                procedure.answer(reply)
        return procedure.result

    async def _follow(self, steps: Steps[None]) -> AsyncIterator[JobView]:
        """Take the steps of a procedure that listens, and give what it shows."""
        procedure = Procedure(steps)
        lines: AsyncIterator[str]
        async with AsyncExitStack() as connection:
            while procedure.step is not None:
                reply: Any = None
                try:
                    match procedure.step:
                        case Show(job):
                            yield job
                        case Listen(call):
                            await connection.aclose()
                            stream = self._http.stream(**arguments_of(call), timeout=LISTENING)
                            reply = await connection.enter_async_context(stream)
                            if has_events(reply):
                                lines = reply.aiter_lines()
                            else:
                                await reply.aread()
                        case NextLine():
                            reply = await anext(lines, None)
                        case step:
                            reply = await self._take(step)
                except httpx.TransportError as error:
                    procedure.fail(unreachable(self.url, error))
                else:
                    procedure.answer(reply)

    async def _take(self, step: Step) -> httpx.Response | None:
        match step:
            case Call():
                content = None if step.body is None else _sending(step.body)
                return await self._http.request(**arguments_of(step), content=content)
            case Pause(seconds):
                await anyio.sleep(seconds)
        return None


async def _sending(body: Body) -> AsyncIterator[bytes]:
    """The pieces, read by a thread, since a disk may be slow."""
    pieces, sent_bytes = body.pieces(), 0
    while (piece := await anyio.to_thread.run_sync(next, pieces, None)) is not None:
        yield piece
        sent_bytes += len(piece)
        body.on_sent(sent_bytes)
