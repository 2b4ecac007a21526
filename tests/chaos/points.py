"""Points in the processes under test at which they stop, so that they can be killed exactly there.

A process reaches a point by reach(). If that point is armed it says so and waits, for the harness to kill something or
to let it go on; a point is armed for one arrival. The processes are the real ones: install_service_points() and
install_worker_points() only wrap the methods between which the points lie.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any

FOLDER_VARIABLE = "INTRASPLAT_CHAOS_FOLDER"
POLL_S = 0.005
MAX_HELD_S = 30.0


class Point(StrEnum):
    """Where a job can be when something dies, in a job's order."""

    UPLOAD = "during upload"
    SPOOLED = "after fsync, before enqueue"
    ENQUEUED = "after enqueue, before the reply"
    CLAIMED = "claimed"
    KEEPING = "state written, not in place"
    TRAINING = "training"
    TRAINED = "trained, before its scene"
    PUBLISHING = "publishing"
    PUBLISHED = "after publish, before ack"
    SCORING = "done, before its scores"
    TELLING = "before its webhook is sent"
    TOLD = "after its webhook, before that is noted"


class Points:
    """The harness's side: arm, see what has arrived, let go."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def arm(self, point: Point) -> None:
        """Stop the next process that reaches the point."""
        self._file("arm", point).touch()

    def wait_for(self, point: Point, timeout_s: float) -> int:
        """The process id of the process that has arrived.

        Raises:
            TimeoutError: nobody came.
        """
        deadline_s = time.monotonic() + timeout_s
        arrived = self._file("at", point)
        while not arrived.exists():
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"nothing reached {point.value!r} within {timeout_s:g} s")
            time.sleep(POLL_S)
        return int(arrived.read_text())

    def let_go(self) -> None:
        """Disarm all points and let all processes go on."""
        for path in self.folder.iterdir():
            if path.name.startswith("arm."):
                path.unlink(missing_ok=True)
            elif path.name.startswith("at."):
                path.rename(path.with_name("go." + path.name.removeprefix("at.")))

    def reset(self) -> None:
        """Forget all arrivals."""
        for path in self.folder.iterdir():
            path.unlink(missing_ok=True)

    def _file(self, kind: str, point: Point) -> Path:
        return self.folder / f"{kind}.{point.name}"


def reach(point: Point) -> None:
    """Stop here if the point is armed."""
    folder = Path(os.environ[FOLDER_VARIABLE])
    try:
        (folder / f"arm.{point.name}").unlink()
    except FileNotFoundError:
        return
    arriving = folder / f"arriving.{point.name}"
    arriving.write_text(str(os.getpid()))
    arriving.rename(folder / f"at.{point.name}")
    deadline_s = time.monotonic() + MAX_HELD_S
    while not (folder / f"go.{point.name}").exists() and time.monotonic() < deadline_s:
        time.sleep(POLL_S)


def install_service_points() -> None:
    """SPOOLED lies after the store's accept, ENQUEUED after the queue's submit; TELLING and TOLD around a webhook."""
    from contract.queue.redis_queue import RedisQueue
    from contract.store.store import Store

    _reach_after(Store, "accept", Point.SPOOLED)
    _reach_after(RedisQueue, "submit", Point.ENQUEUED)
    _reach_after(RedisQueue, "claim_delivery", Point.TELLING, if_any=True)
    _reach_before(RedisQueue, "record_try", Point.TOLD)


def install_worker_points() -> None:
    """CLAIMED lies after a claim that gave a job; PUBLISHING before the store's rename, PUBLISHED after it."""
    from contract.queue.redis_queue import RedisQueue
    from contract.store.store import Store

    _reach_after(RedisQueue, "claim", Point.CLAIMED, if_any=True)
    _reach_before(Store, "publish_scene", Point.PUBLISHING)
    _reach_after(Store, "publish_scene", Point.PUBLISHED)


def _reach_after(owner: type, name: str, point: Point, *, if_any: bool = False) -> None:
    method: Callable[..., Any] = getattr(owner, name)

    @functools.wraps(method)
    def wrapped(*arguments: Any, **named: Any) -> Any:
        result = method(*arguments, **named)
        if result is not None or not if_any:
            reach(point)
        return result

    setattr(owner, name, wrapped)


def _reach_before(owner: type, name: str, point: Point) -> None:
    method: Callable[..., Any] = getattr(owner, name)

    @functools.wraps(method)
    def wrapped(*arguments: Any, **named: Any) -> Any:
        reach(point)
        return method(*arguments, **named)

    setattr(owner, name, wrapped)
