"""The supervisor's side of live feeds: claim them, beat for them, keep a process for each, delete what has ended."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from contract.queue.embedded import short_socket_path
from contract.queue.feeds import FEED_BEAT_S, FeedClaim
from contract.queue.interface import Queue
from contract.store.feed_files import FeedFiles
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from intrasplat.errors import UnavailableError
from intrasplat.live.state import FeedState
from intrasplat.machine.hooks import ignore
from worker.announce import announced
from worker.feed_child import FeedChild

FEED_COMMAND = (sys.executable, "-m", "worker", "feed")
LOOK_PERIOD_S = 0.1
CLAIM_PERIOD_S = 0.5
RETRY_S = NOTICE_PERIOD_S = 1.0
PORTS, MAX_PORT = 16, 65535
"""Over TCP the processes of feeds take the first free ones of so many ports after the worker's own."""
TIDY_PERIOD_S = 30.0
"""Between two looks for files of feeds that ended while another machine followed them."""

logger = logging.getLogger("intrasplat.worker")


@dataclass(eq=False)
class _Followed:
    """A feed that this worker follows. ending: its files are being deleted."""

    claim: FeedClaim
    record: FeedRecord
    child: FeedChild | None
    announcing: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    ending: bool = False
    wishes_end: bool = False
    beat_at_s: float = 0.0
    said: tuple[object, ...] = ()


class FeedHost:
    """Follows up to `places` feeds. One thread calls run().

    owner      the name of the worker, a dot, and a token that is new at each start of the supervisor
    on_look    called about once a second with the ids of the feeds that are followed
    endpoints  where the process that is announced under a name may answer, the first choice first
    """

    def __init__(
        self,
        queue: Queue,
        files: FeedFiles,
        owner: str,
        places: int,
        endpoints: Callable[[str], tuple[str, ...]],
        environment: Mapping[str, str] | None = None,
        command: Sequence[str] = FEED_COMMAND,
        on_look: Callable[[Sequence[str]], object] = ignore,
    ) -> None:
        self._queue, self._files, self._owner, self._places = queue, files, owner, places
        self._endpoints, self._environment, self._command = endpoints, environment, command
        self._followed: dict[str, _Followed] = {}
        self._on_look = on_look
        self._claim_at_s = self._look_at_s = self._tidy_at_s = 0.0
        self._away = False

    @property
    def followed(self) -> tuple[str, ...]:
        """Ids of the feeds that are followed; any thread may ask."""
        return tuple(self._followed)

    def run(self, end: threading.Event) -> None:
        """Follow feeds until `end` is set; then close and release them."""
        while not end.wait(LOOK_PERIOD_S):
            try:
                self.step()
            except Exception as error:  # one feed's trouble must not end the others
                logger.error("live feeds: %s", type(error).__name__, exc_info=error)
        self._stop()

    def step(self) -> None:
        """Do what is due now."""
        if self._is_due("_claim_at_s", CLAIM_PERIOD_S):
            with self._reaching():
                self._claim()
        for each in list(self._followed.values()):
            if each.child is not None:
                each.child.look()
            with self._reaching():
                self._beat(each)
        if self._is_due("_look_at_s", NOTICE_PERIOD_S):
            self._on_look(self.followed)
        if self._is_due("_tidy_at_s", TIDY_PERIOD_S):
            with self._reaching():
                self._tidy()

    def _is_due(self, name: str, period_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < getattr(self, name):
            return False
        setattr(self, name, now_s + period_s)
        return True

    @contextlib.contextmanager
    def _reaching(self) -> Iterator[None]:
        """Go on without the queue or the disk if it does not answer."""
        try:
            yield
        except UnavailableError as error:
            if not self._away:
                logger.warning("live feeds: %s", error.problem)
            self._away = True
        else:
            self._away = False

    def _claim(self) -> None:
        record = self._queue.claim_feed(self._owner, to_end=len(self._followed) >= self._places)
        if record is None:
            return
        claim = FeedClaim(record.feed_id, record.epoch, self._owner)
        if record.wish is FeedWish.END:
            self._followed[record.feed_id] = _Followed(claim, record, None, ending=True)
            return
        logger.info("a feed is claimed", extra={"job_id": record.feed_id})
        name = f"{self._owner.rpartition('.')[0]}-feed-{record.feed_id}"
        try:
            folder = self._files.make(record.feed_id, record.created_at_s)
        except UnavailableError:
            self._queue.release_feed(claim)  # another worker's disk may take it
            raise
        child = FeedChild(record, folder, self._endpoints(name), self._command, self._environment)
        followed = _Followed(claim, record, child)
        followed.announcing.enter_context(announced(self._queue, name, lambda: child.address(name)))
        self._followed[record.feed_id] = followed

    def _beat(self, each: _Followed) -> None:
        """Report on a feed if that is due, and do what its caller wants."""
        report = FeedReport(state=FeedState.ENDED, since_s=time.time()) if each.child is None else each.child.report()
        said = report.state, report.reason, report.recording
        now_s = time.monotonic()
        if said == each.said and now_s < each.beat_at_s:
            return
        each.beat_at_s = now_s + RETRY_S
        wish = self._queue.beat_feed(each.claim, report)
        each.said, each.beat_at_s = said, now_s + FEED_BEAT_S
        if wish is None:
            logger.warning("a feed is followed by another worker now", extra={"job_id": each.record.feed_id})
            self._drop(each)
        elif wish is FeedWish.END or each.ending:
            self._end(each)
        elif each.child is not None and wish is not each.child.wish:
            each.child.order(wish)
        elif report.state is FeedState.ENDED and time.time() - report.since_s > each.record.options.keep_s:
            self._queue.wish_feed(each.record.feed_id, FeedWish.END)

    def _end(self, each: _Followed) -> None:
        """Delete all that a feed has, and its record; it is tried again until that is done."""
        each.ending = True
        if each.child is not None:
            each.child.kill()
            each.child = None
        each.announcing.close()
        self._files.remove(each.record.feed_id)
        self._queue.forget_feed(each.claim)
        self._followed.pop(each.record.feed_id, None)
        logger.info("a feed has ended, and its files are deleted", extra={"job_id": each.record.feed_id})

    def _drop(self, each: _Followed) -> None:
        """Follow a feed no longer. Its files stay: its new worker may have the same data directory."""
        self._followed.pop(each.record.feed_id, None)
        if each.child is not None:
            each.child.kill()
        each.announcing.close()

    def _tidy(self) -> None:
        """Delete files of feeds that are not in the queue any more."""
        for feed_id in self._files.ids():
            if feed_id not in self._followed and self._queue.tenant_of_feed(feed_id) is None:
                self._files.remove(feed_id)
                logger.info("the files of a feed that has ended are deleted", extra={"job_id": feed_id})

    def _stop(self) -> None:
        all_of_them = list(self._followed.values())
        for each in all_of_them:
            if each.child is not None:
                each.child.ask_to_end()
        for each in all_of_them:
            if each.child is not None:
                each.child.stop()
            each.announcing.close()
            with self._reaching():
                self._queue.release_feed(each.claim)
        self._followed.clear()


def endpoints_of(name: str, run_dir: Path, render_endpoint: str | None) -> tuple[str, ...]:
    """Where the process of a feed may answer: a socket, or a port after that of the worker."""
    if render_endpoint is None:
        return (f"ipc://{short_socket_path(run_dir, f'{name}.sock')}",)
    host, _, port = render_endpoint.rpartition(":")
    return tuple(f"{host}:{each}" for each in range(int(port) + 1, min(int(port) + PORTS, MAX_PORT) + 1))


@contextlib.contextmanager
def following(host: FeedHost) -> Iterator[None]:
    """Follow feeds while the context lasts."""
    end = threading.Event()
    thread = threading.Thread(target=host.run, args=(end,), name="feeds")
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
