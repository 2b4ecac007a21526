"""Store what a killed run resumes from: the clip with depth, and the run's state about every PERIOD_S.

The files in the folder are always complete. If the disk is full, nothing is stored and the run goes on.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.clip.layouts import registered_files
from intrasplat.clip.stored import load_clip, save_clip
from intrasplat.errors import Cancelled
from intrasplat.names import PREPARED, RESUME_STATE
from intrasplat.poses import StoredPoses
from intrasplat.scene.resume_file import RESUME_FILE
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.resume import begin_save
from intrasplat.train.run import Run

PERIOD_S = 10.0
"""Seconds of training between two stored states."""
MAX_SHARE = 0.05
"""Largest share of the time spent on storing states. A long clip's state takes long, so it is stored less often."""
NICENESS = 10
"""Niceness of the writing threads: copying a clip takes half a second of a core while training needs all cores."""
SPARE_BYTES = 1 << 30
"""Nothing is stored that would leave less free disk space than this."""

logger = logging.getLogger(__name__)


@contextmanager
def keeping(folder: Path, *, forgets: bool) -> Iterator[Keeper]:
    """A keeper of one run; when the with statement ends, everything is on disk.

    Args:
        forgets: whether to remove the stored files at the end: all of them after success, and after an error those
            that this keeper wrote. After Cancelled they stay, so that the run can be resumed.
    """
    keeper = Keeper(folder)
    try:
        yield keeper
    except BaseException as error:
        keeper.close()
        if forgets and isinstance(error, Exception) and not isinstance(error, Cancelled):
            keeper.forget(keeper.written)
        raise
    keeper.close()
    if forgets:
        keeper.forget(RESUME_STATE)


class Keeper:
    """Stores one run in a folder. Two threads write and wait for the disk: one the clip, one a state at a time.

    written: names of RESUME_STATE that this keeper has written
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ending = threading.Event()
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="keep", initializer=_lower_priority)
        self._state: Future[None] | None = None
        self._due_s: float | None = None
        self.written: set[str] = set()

    def close(self) -> None:
        """Wait until everything is on disk. A clip that is still being written is abandoned."""
        self._ending.set()
        self._threads.shutdown()

    def forget(self, names: Collection[str]) -> None:
        """Remove the files of these names of RESUME_STATE; call it after close()."""
        if RESUME_FILE in names:
            (self.folder / RESUME_FILE).unlink(missing_ok=True)
        if PREPARED in names:
            shutil.rmtree(self.folder / PREPARED, ignore_errors=True)

    def clip(self, request: ReconstructionRequest, open_anew: Callable[[], DepthClip]) -> DepthClip:
        """The stored clip of the request if there is one, else that of open_anew(), which is then stored."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if isinstance(request.clip, DepthClip):
            return open_anew()
        folder, identity = self.folder / PREPARED, _identity(request)
        kept = load_clip(folder, identity)
        if kept is not None:
            return kept
        clip = open_anew()
        self.written.add(PREPARED)
        size_bytes = sum(each.rgb.size * 3 for each in clip.eyes)  # 9 bytes a pixel
        self._submit(lambda: save_clip(folder, clip, identity, self._ending.is_set), size_bytes)
        return clip

    def keep_if_due(self, run: Run) -> None:
        """Store the run's state if that is due. Call it between two steps: it is due at the first call, unless the run
        was resumed, and then every PERIOD_S."""
        now_s = time.monotonic()
        if self._due_s is None:
            self._due_s = now_s + PERIOD_S if (self.folder / RESUME_FILE).exists() else now_s
        if now_s >= self._due_s and (self._state is None or self._state.done()):
            self._begin(run)
            took_s = time.monotonic() - now_s
            self._due_s = now_s + max(PERIOD_S, took_s / MAX_SHARE)

    def keep(self, run: Run) -> None:
        """Store the run's state as it is now; close() waits for it. A clip that is still being written is abandoned."""
        self._ending.set()
        if self._state is not None:
            self._state.exception()
        self._begin(run)

    def _begin(self, run: Run) -> None:
        """Copy the state to the page cache here, and let a thread wait for the disk."""
        t_train_s = run.setup.timings.seconds.get("t_train_s", run.setup.clock.elapsed_s)
        size_bytes = sum(each.numel() * each.element_size() for each in run.model.arrays().values())
        try:
            complete = begin_save(self.folder, run, t_train_s) if self._has_free_space(size_bytes) else None
        except OSError as error:
            logger.warning("the state of training was not kept: %s", error.strerror)
            return
        if complete is not None:
            self.written.add(RESUME_FILE)
            self._state = self._submit(complete, 0)

    def _submit(self, work: Callable[[], None], size_bytes: int) -> Future[None]:
        def attempt() -> None:
            try:
                if self._has_free_space(size_bytes):
                    work()
            except OSError as error:
                logger.warning("what a later attempt could go on from was not kept: %s", error.strerror)
            except Exception:
                logger.exception("what a later attempt could go on from was not kept")

        return self._threads.submit(attempt)

    def _has_free_space(self, size_bytes: int) -> bool:
        return shutil.disk_usage(self.folder).free >= size_bytes + SPARE_BYTES


def _lower_priority() -> None:
    """Lower the priority of the calling thread. Only on Linux: elsewhere nice() is for the whole process."""
    if sys.platform == "linux":
        os.nice(NICENESS)


def _identity(request: ReconstructionRequest) -> str:
    """A hash that identifies the prepared clip: name, size and mtime of every file, the options, our version."""
    given = (
        request.clip,
        request.right,
        request.calibration,
        request.masks,
        request.segmenter,
        request.poses,
        request.fov_mask,
    )
    found = hashlib.sha256(f"{version('intrasplat')} {request.options.model_dump_json()}".encode())
    if isinstance(request.poses, StoredPoses):
        found.update(request.poses.matrices.tobytes())
    if isinstance(request.fov_mask, np.ndarray):
        found.update(request.fov_mask.tobytes())
    for place, path in enumerate((*given, *registered_files())):
        if isinstance(path, Path):
            for file in _files_of(path):
                with contextlib.suppress(OSError):  # opening the clip says what is missing
                    state = file.stat()
                    name = file.relative_to(path.parent)
                    found.update(f"\n{place} {name} {state.st_size} {state.st_mtime_ns}".encode())
    return found.hexdigest()


def _files_of(path: Path) -> Iterator[Path]:
    """The file itself, or every file below the folder, in the order of their names."""
    if not path.is_dir():
        yield path
        return
    for folder, subfolders, names in os.walk(path):
        subfolders.sort()
        yield from (Path(folder) / name for name in sorted(names))
