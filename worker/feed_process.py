"""The process that follows one live feed, and answers renders of it.

It belongs to a supervisor (worker/feeds.py), obeys worker/feed_orders.py, and dies with its supervisor.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import BinaryIO

from pydantic import ValidationError

from contract.queue.feeds import FEED_BEAT_S
from contract.runtime import traces
from contract.runtime.settings import Settings
from contract.store.local import remove_tree
from contract.wire.feeds import FeedWish
from contract.wire.rendering import CutRequest, PushRequest
from intrasplat.errors import UnavailableError
from intrasplat.machine.processes import die_with_parent
from intrasplat.splat.backend import CPU, CPU_BY_VARIABLE, choose_device
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.cpu.threads import alone, cpu_time_s, thread_count
from worker.aside import Aside
from worker.channel import TRACES_PATIENCE_S, Channel
from worker.feed_cuts import FeedCuts
from worker.feed_orders import FeedReady, FeedReported, FollowFeed, WishFeed, read_feed_order
from worker.feed_pushes import FeedPushes
from worker.feed_views import FeedViews
from worker.hosted_feed import HostedFeed
from worker.pace import RenderPace
from worker.scheduler import MAX_WAIT_SHARE, Scheduler
from worker.serve import RequestServer

LOOK_PERIOD_S = 0.1
"""How soon a change of the feed's state is reported."""
SHARE = 0.4
"""Renders' share of the CPU time: the rest follows the feed."""
MAX_DEBT_S = 0.25
"""CPU seconds: what a render takes beyond them delays the next one no further."""
MAX_CLOSE_S = 4.0
"""For the feed to end in order."""

logger = logging.getLogger("intrasplat.worker")


def run_feed(settings: Settings) -> None:
    """Follow the feed that the first order on stdin names. It never returns: the end of the orders ends the process."""
    die_with_parent()
    channel = Channel.instead_of_stdout()
    lines = os.fdopen(os.dup(sys.stdin.fileno()), "rb")
    order = _first(lines)
    scratch = order.folder / "scratch"
    remove_tree(scratch)
    scratch.mkdir(mode=0o700)
    tempfile.tempdir = str(scratch)
    device = choose_device(settings.device, cpu_by=CPU_BY_VARIABLE)
    hosted = HostedFeed(order.record, order.folder, settings, device)
    hosted.wish(order.record.wish)
    hosted.begin()
    _Wishes(lines, hosted)
    threading.Thread(target=_report, args=(hosted, channel), name="reports", daemon=True).start()
    if device == CPU:
        compile_kernels()  # the feed connects meanwhile
    views = FeedViews(hosted, device)
    # The first render of a scene may compile kernels for seconds; the next one must not wait for as long.
    pace = RenderPace(thread_count(), used_s=time.process_time, max_debt_s=MAX_DEBT_S, share=SHARE)
    scheduler = Scheduler(
        views.answer_in_parts,
        pace,
        cost=views.cost,
        within=lambda: alone(is_alone=True),
        spent_s=cpu_time_s,
        max_wait_s=settings.render_timeout_s * MAX_WAIT_SHARE,
    )
    cuts = FeedCuts(hosted, scratch)
    aside = Aside({PushRequest: FeedPushes(hosted).take, CutRequest: cuts.part})

    def forget_idle() -> None:
        views.forget_idle()
        cuts.forget_idle()

    with pace.training(), _serving(settings, order.endpoints, scheduler, aside, forget_idle) as server:
        channel.send(FeedReady(endpoint=server.endpoint, device=str(device)))
        logger.info("a feed is followed on %s", device, extra={"job_id": hosted.feed_id})
        threading.Event().wait()  # the end of the orders ends this process


def _first(lines: BinaryIO) -> FollowFeed:
    line = lines.readline()
    order = read_feed_order(line) if line else None
    if not isinstance(order, FollowFeed):
        raise SystemExit(0)  # the supervisor has ended
    return order


def _report(hosted: HostedFeed, channel: Channel) -> None:
    """Report what the feed does, for ever. A process that cannot is replaced."""
    last, next_s = None, 0.0
    while True:
        report = hosted.report()
        state = report.state, report.reason, report.recording
        if state != last or time.monotonic() >= next_s:
            channel.send(FeedReported(report=report))
            last, next_s = state, time.monotonic() + FEED_BEAT_S
        time.sleep(LOOK_PERIOD_S)


class _Wishes:
    """Obeys the further orders in threads, and ends the process when they end."""

    def __init__(self, lines: BinaryIO, hosted: HostedFeed) -> None:
        self._lines, self._hosted = lines, hosted
        self._wishes: queue.SimpleQueue[FeedWish] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="orders", daemon=True).start()
        threading.Thread(target=self._obey, name="wishes", daemon=True).start()

    def _read(self) -> None:
        for line in self._lines:
            try:
                order = read_feed_order(line)
            except ValidationError:
                logger.error("an order cannot be read; restart the worker after updating the program")
                os._exit(1)
            if isinstance(order, WishFeed):
                self._wishes.put(order.wish)
        closing = threading.Thread(target=self._hosted.close, daemon=True)
        closing.start()
        closing.join(MAX_CLOSE_S)
        traces.flush(TRACES_PATIENCE_S)
        os._exit(0)

    def _obey(self) -> None:
        while True:
            try:
                self._hosted.wish(self._wishes.get())
            except Exception as error:  # a pause that is not obeyed would record what nobody wants recorded
                logger.error("a wish could not be obeyed: %s; another process begins with it", type(error).__name__)
                os._exit(1)


@contextlib.contextmanager
def _serving(
    settings: Settings, endpoints: Sequence[str], scheduler: Scheduler, aside: Aside, between: Callable[[], None]
) -> Iterator[RequestServer]:
    """Answer requests at the first address that is free."""
    refused: UnavailableError | None = None
    for endpoint in endpoints:
        server = RequestServer(endpoint, scheduler, aside=aside, between=between, render_secret=settings.render_secret)
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(server)
            except UnavailableError as error:
                refused = error
                continue
            yield server
            return
    assert refused is not None
    raise refused
