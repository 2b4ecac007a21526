"""Client: one blocking method a route, typed answers, errors as exceptions (errors.py)."""

from __future__ import annotations

import functools
from collections.abc import AsyncGenerator, Callable, Coroutine, Generator
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

import httpx

from intrasplat_client.connection import DEFAULT_URL, BlockingConnection, http_settings, iterate, run
from intrasplat_client.core import Core
from intrasplat_client.session import DEFAULT_PATIENCE_S, OnWait
from intrasplat_client.viewer import StreamMessages, Viewer

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class _Blocking:
    """The attributes that methods created by _blocking() need."""

    _core: Core


def _blocking(
    method: Callable[Concatenate[Core, Arguments], Coroutine[Any, Any, Result]],
) -> Callable[Concatenate[_Blocking, Arguments], Result]:
    """Turn a method of Core into a blocking one of Client, with the same arguments, types and docstring."""

    def call(self: _Blocking, /, *args: Arguments.args, **named: Arguments.kwargs) -> Result:
        return run(method(self._core, *args, **named))

    return functools.update_wrapper(call, method)


def _iterating(
    method: Callable[Concatenate[Core, Arguments], AsyncGenerator[Result, None]],
) -> Callable[Concatenate[_Blocking, Arguments], Generator[Result, None, None]]:
    """As _blocking(), for a method whose results come one by one."""

    def call(self: _Blocking, /, *args: Arguments.args, **named: Arguments.kwargs) -> Generator[Result, None, None]:
        return iterate(method(self._core, *args, **named))

    return functools.update_wrapper(call, method)


class Client(_Blocking):
    """A connection to one service: use it as a context, or call close().

    api_key: from `intrasplat keys create`; needed unless the service runs on this machine for its user alone.
    patience_s: how long, in total, a call waits while the service is busy (429, 503) or the connection is lost. If
    nothing listens at the address, a call fails at once.
    on_wait(error, pause_s): called before each of these waits.
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

    reconstruct = _blocking(Core.reconstruct)
    import_scene = _blocking(Core.import_scene)
    job = _blocking(Core.job)
    jobs = _blocking(Core.jobs)
    label = _blocking(Core.label)
    deliveries = _blocking(Core.deliveries)
    send_again = _blocking(Core.send_again)
    cancel = _blocking(Core.cancel)
    retry = _blocking(Core.retry)
    watch = _iterating(Core.watch)
    wait = _blocking(Core.wait)
    render = _blocking(Core.render)
    render_array = _blocking(Core.render_array)
    scenes = _blocking(Core.scenes)
    report = _blocking(Core.report)
    curve = _blocking(Core.curve)
    masks = _blocking(Core.masks)
    thumbnail = _blocking(Core.thumbnail)
    recorded = _blocking(Core.recorded)
    cameras = _blocking(Core.cameras)
    measure = _blocking(Core.measure)
    exports = _blocking(Core.exports)
    export = _blocking(Core.export)
    file = _blocking(Core.file)
    delete = _blocking(Core.delete)
    open_feed = _blocking(Core.open_feed)
    feeds = _blocking(Core.feeds)
    feed = _blocking(Core.feed)
    pause_feed = _blocking(Core.pause_feed)
    resume_feed = _blocking(Core.resume_feed)
    cut_feed = _blocking(Core.cut_feed)
    end_feed = _blocking(Core.end_feed)
    key = _blocking(Core.key)
    info = _blocking(Core.info)
    is_ready = _blocking(Core.is_ready)

    def stream(self, scene: str) -> Viewer:
        """A connection for many views: `with client.stream(scene) as viewer: viewer.render(t, pose)`."""
        return Viewer(StreamMessages(self.url, scene, self._api_key))

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
