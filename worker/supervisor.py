"""The worker's main process: it holds the claims, and its child uses the device. Either may die at any time.

Nothing here imports torch or compiles anything, so this process starts fast, needs little memory and never hangs.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import partial

from contract.queue.installed import check_queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.store.feed_files import FeedFiles
from contract.store.store import Store, open_store
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError
from intrasplat.formats import missing_extras
from intrasplat.machine.processes import set_niceness
from worker.announce import LOOK_PERIOD_S, announced
from worker.child import ChildKeeper
from worker.consume import Consumer
from worker.feeds import FeedHost, endpoints_of, following

TIDY_PERIOD_S = 600.0
"""Time between two clean-ups of the store: so long a local copy may outlive a scene purged on another machine."""

NICENESS, MAX_NICENESS = 10, 19
"""Added for jobs and renders of scenes while a feed is followed; the most that there is."""

DEVICE_COMMAND = (sys.executable, "-m", "worker", "device")

logger = logging.getLogger("intrasplat.worker")


def run_supervisor(
    settings: Settings,
    end: threading.Event,
    child_command: Sequence[str] | None = None,
    *,
    renders_only: bool = False,
) -> None:
    """Work until `end` is set; wait while the queue cannot be reached.

    Args:
        child_command: the program to run instead of `python -m worker device`; it must obey worker/orders.py.
        renders_only: claim no jobs; answer renders of finished scenes.

    Raises:
        UnavailableError: a worker of this name already works on this data directory, the queue refuses this one, or the
            child cannot work here.
    """
    assert settings.redis_url is not None
    store = open_store(settings)
    name = settings.worker_name
    lock = FolderLock(store.run_dir / f"{name}.lock")
    if not lock.take():
        problem = f"A worker named {name} already works on {store.data_dir}."
        raise UnavailableError(problem, "End it, or set another INTRASPLAT_WORKER_NAME.")
    queue = RedisQueue(settings.redis_url)
    environment = {**os.environ, **settings.to_environment()}
    keeper = ChildKeeper(child_command or DEVICE_COMMAND, environment, store.run_dir / f"{name}.device.last-words")
    # The owner's name is new at each start, so that late messages of an earlier process of this name have no effect.
    owner = f"{name}.{secrets.token_hex(4)}"
    consumer = Consumer(queue, store, keeper, name, owner, end, settings.min_free_bytes)
    # A worker without a place for feeds ends those that it has followed before.
    endpoints = partial(endpoints_of, run_dir=store.run_dir, render_endpoint=settings.render_endpoint)
    files, places = FeedFiles(store.data_dir), settings.feeds
    let_feeds_first = partial(set_priority, keeper)
    host = FeedHost(queue, files, owner, places, endpoints, environment, on_look=let_feeds_first)
    try:
        check_queue(queue)
        with (
            announced(queue, name, lambda: address_of(name, keeper, consumer, renders_only=renders_only)),
            periodic_tidy(store),
            contextlib.nullcontext() if renders_only else following(host),
        ):
            if renders_only:
                keep_rendering(keeper, end)
            else:
                consumer.claim_file.give_back(queue)
                consumer.run()
    finally:
        keeper.stop()
        queue.close()
        lock.release()


def set_priority(keeper: ChildKeeper, feed_ids: Sequence[str]) -> None:
    """Let feeds that are followed come before the child's jobs and renders; its own niceness returns where it may."""
    child = keeper.live
    if child is not None and (feed_ids or child.is_nice):
        child.is_nice = bool(feed_ids)
        set_niceness(child.process.pid, min(MAX_NICENESS, os.nice(0) + (NICENESS if feed_ids else 0)))


def keep_rendering(keeper: ChildKeeper, end: threading.Event) -> None:
    """Keep the child, which answers renders, running until `end` is set; raises as ChildKeeper.child."""
    while keeper.child(end) is not None and not end.wait(LOOK_PERIOD_S):
        pass


def address_of(
    name: str, keeper: ChildKeeper, consumer: Consumer, *, renders_only: bool = False
) -> WorkerAddress | None:
    """The address that a worker announces now; None while its child is not ready."""
    child = keeper.live
    if child is None or child.ready is None:
        return None
    ready = child.ready
    return WorkerAddress(
        name=name,
        endpoint=ready.endpoint,
        device=ready.device,
        job_id=consumer.job_id,
        scenes=child.scenes,
        renders_only=renders_only,
        missing_extras=missing_extras(),
    )


@contextlib.contextmanager
def periodic_tidy(store: Store) -> Iterator[None]:
    """Tidy the store every TIDY_PERIOD_S while the context lasts."""
    end = threading.Event()

    def tidy() -> None:
        while not end.is_set():
            try:
                store.tidy()
            except UnavailableError as error:
                logger.warning("the store was not tidied: %s", error.problem)
            end.wait(TIDY_PERIOD_S)

    threading.Thread(target=tidy, name="tidy", daemon=True).start()  # not joined: an S3 bucket may answer slowly
    try:
        yield
    finally:
        end.set()
