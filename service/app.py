"""create_app: the HTTP application. Routes parse, make one call and return; nothing here computes an image."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from fastapi import FastAPI

from contract.queue.interface import Queue
from contract.runtime.settings import LOOPBACK_NAMES, Settings
from contract.store.store import Store
from intrasplat.version import version
from service import (
    check,
    exports,
    feed_cut,
    feed_push,
    feeds,
    imports,
    jobs,
    measure,
    reconstruct,
    recorded,
    renders,
    scene_files,
    scenes,
    stream,
    system,
    thumbnails,
    tus,
)
from service.audit import install_refusal_handler
from service.deps import Deps
from service.guard import Guard
from service.head import HeadAsGet
from service.metrics import Measure
from service.missing import install_missing_handler
from service.openapi import DescribedApp
from service.page import page_files
from service.problems import install_handlers
from service.renderer import Renderer
from service.request_log import RequestLog

DESCRIPTION = (
    "A stereo endoscope clip goes in, a dynamic model of the tissue answers renders at any time and pose. "
    "Research use only; not a medical device.\n\n"
    "The WebSocket /stream shows many views over one connection. Send the parameters of /render as a JSON text, with "
    "an `id` of your choice. A view is one binary message: 4 bytes, big-endian, with the length of the head, the head "
    "(JSON), the image. A JSON text with `status` is an error; one with `state` and no `status` answers `confirm`. "
    "docs/stream.md of the source has the messages, keys, close codes and an example."
)

BACKGROUND_PAUSE_S = 10.0

logger = logging.getLogger("intrasplat.service")


def create_app(settings: Settings, queue: Queue, store: Store, renderer: Renderer) -> FastAPI:
    """The application. It owns `queue` and `renderer` and closes them when it ends."""
    deps = Deps(settings, queue, store, renderer)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        background = (deps.sweep.run, deps.retention.run, deps.webhooks.run, renderer.run)
        tasks = [asyncio.create_task(_restart_on_error(run)) for run in background]
        yield
        deps.end_channels()
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        await renderer.close()
        deps.questions.close()
        queue.close()

    app = DescribedApp(
        title="intrasplat",
        version=version(),
        description=DESCRIPTION,
        docs_url=None,  # they would load scripts from a CDN
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.deps = deps
    app.add_middleware(HeadAsGet)
    app.add_middleware(Guard, hosts=LOOPBACK_NAMES | {settings.host, *settings.hosts}, origins=settings.cors_origins)
    app.add_middleware(RequestLog)
    app.add_middleware(Measure, metrics=deps.metrics)
    install_handlers(app)
    install_missing_handler(app)
    install_refusal_handler(app, deps.audit)
    scene_parts = (scenes, scene_files, recorded, thumbnails, measure, exports, imports)
    for part in (reconstruct, check, tus, jobs, renders, stream, *scene_parts, feeds, feed_cut, feed_push, system):
        app.include_router(part.router)
    if settings.dashboard_dir is not None:
        app.mount("/", page_files(settings.dashboard_dir), name="dashboard")
    return app


async def _restart_on_error(run: Callable[[], Awaitable[None]]) -> None:
    """Run background work, and run it again after an unexpected error."""
    while True:
        try:
            await run()
        except Exception:
            logger.exception("work in the background failed and starts again")
        await asyncio.sleep(BACKGROUND_PAUSE_S)
