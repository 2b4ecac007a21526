"""Pass snapshots (copies of the model in training) from the training loop to the renders.

The loop copies its model if a render was asked for since the last copy, and that copy is older than PERIOD_S. So a job
that nobody watches spends no time and no memory on copies. Training never waits here; a render waits up to PATIENCE_S
for a copy that is due.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from intrasplat.clip import DepthClip
from intrasplat.scene.scene import TrainedScene

PERIOD_S = 1.0
"""Minimum time between two copies of one job's model."""

COPY_SHARE = 0.05
"""Largest share of the training time that copies may take: slow copies are made less often."""
SLOWEST = 5
"""Most periods between two copies."""

PATIENCE_S = 0.3
"""How long a render waits for a copy that is due: some training steps. Then it shows the last copy."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The scene after `iteration` iterations, and when it was copied (monotonic).

    of_one_moment: it shows one moment only, before there is a model (intrasplat/train/first_picture.py).
    """

    scene: TrainedScene
    iteration: int
    taken_s: float
    of_one_moment: bool = False


class Snapshots:
    """Stores the newest snapshot of at most one job, and its clip; for one training thread and any number of others."""

    def __init__(self, period_s: float = PERIOD_S, patience_s: float = PATIENCE_S) -> None:
        self._period_s = period_s
        self._patience_s = patience_s
        self._changed = threading.Condition()
        self._job_id: str | None = None
        self._newest: Snapshot | None = None
        self._clip: DepthClip | None = None
        self._asked = False
        self._answers = True
        self._wanted_s = self._copy_s = 0.0

    def begin(self, job_id: str) -> None:
        """Start a job: drop the snapshot of the job before."""
        with self._changed:
            self._job_id, self._newest, self._asked, self._answers = job_id, None, False, False
            self._clip = None
            self._changed.notify_all()

    def drop(self, job_id: str) -> None:
        """Drop the snapshot and the clip of this job."""
        with self._changed:
            if self._job_id == job_id:
                self._job_id = self._newest = self._clip = None
                self._changed.notify_all()

    def wanted(self) -> bool:
        """Whether the training loop should offer a copy now (TrainingHooks.wants_snapshot)."""
        with self._changed:
            if self._job_id is None:
                return False
            self._wanted_s, self._answers = time.monotonic(), True
            return self._asked and self._is_due(self._newest)

    def offer(self, scene: TrainedScene, iteration: int) -> None:
        """Show this snapshot from now on (TrainingHooks.on_snapshot)."""
        self._show(Snapshot(scene, iteration, time.monotonic()))

    def offer_first(self, scene: TrainedScene) -> None:
        """Show this scene of one moment until there is a snapshot (TrainingHooks.on_first_picture)."""
        self._show(Snapshot(scene, 0, time.monotonic(), of_one_moment=True))

    def offer_clip(self, clip: DepthClip) -> None:
        """Show the frames of this clip from now on (TrainingHooks.on_clip)."""
        with self._changed:
            if self._job_id is not None:
                self._clip = clip

    def clip(self, job_id: str) -> DepthClip | None:
        """The job's clip; None before it is complete, and after the job was dropped."""
        with self._changed:
            return self._clip if self._job_id == job_id else None

    def _show(self, snapshot: Snapshot) -> None:
        with self._changed:
            if self._job_id is not None:
                self._newest = snapshot
                if not snapshot.of_one_moment:
                    self._copy_s = snapshot.taken_s - self._wanted_s
                # Do not wait for a copy after a first picture: training is still far from its first copy.
                self._asked, self._answers = False, not snapshot.of_one_moment
                self._changed.notify_all()

    def newest(self, job_id: str) -> Snapshot | None:
        """The newest snapshot of the job, or None; asks the loop for a newer one."""
        with self._changed:
            if self._job_id != job_id:
                return None
            self._asked, shown = True, self._newest
            if self._answers and self._is_due(shown):
                # After a timeout, do not wait again until the loop, which may be scoring, calls wanted().
                self._answers = self._changed.wait_for(lambda: self._newest is not shown, self._patience_s)
            return self._newest if self._job_id == job_id else None

    def shown(self, job_id: str) -> Snapshot | None:
        """The newest snapshot of the job, or None, without asking for a newer one."""
        with self._changed:
            return self._newest if self._job_id == job_id else None

    def _is_due(self, snapshot: Snapshot | None) -> bool:
        """Whether it is time for the next copy after this one."""
        if snapshot is None or snapshot.of_one_moment:
            return True
        return time.monotonic() - snapshot.taken_s >= max(
            self._period_s, min(self._copy_s / COPY_SHARE, SLOWEST * self._period_s)
        )
