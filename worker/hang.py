"""Decide when a job hangs: each stage has a limit for the time between two advances.

Time in which its threads waited for a core does not count (Silence in intrasplat/machine/processes.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from types import MappingProxyType

from contract.wire.job import JobProgress
from intrasplat.machine.processes import Silence

STAGE_LIMITS_S: Mapping[str, float] = MappingProxyType(
    {
        "decode": 20.0,  # a frame may take 10 s, which the decoding process enforces first
        "stereo": 30.0,  # a pair of 4096 x 2160 takes 3 s on a slow core; three are aligned without a report
        "compile": 120.0,  # one set of kernels takes seconds, on a crowded machine minutes
        "masks": 60.0,  # a frame takes some 10 ms; with a hospital's own segmenter, seconds
        "poses": 60.0,  # a step of the fit takes up to some seconds
        "fusion": 60.0,  # all frames at once, about 10 ms each
        "motion": 10.0,  # a frame takes some 10 ms
        "start": 120.0,  # least squares for every Gaussian, then the targets of all frames, with no report between
        "calibrate": 150.0,  # UNTIMED_STEPS and TIMED_STEPS are 15 iterations of training
        "train": 10.0,  # an iteration takes 10 to 500 ms
        "finish": 150.0,  # finding the motion patterns of a long clip takes some 10 s
        "score": 60.0,  # a frame takes some 100 ms; then come the copy baselines and the files
    }
)
"""Limits for the stages of intrasplat/pipeline.py: at least ten times as long as a step took on slow machines."""

OTHER_LIMIT_S = 60.0
"""The limit of any other stage, and of the time before the first report."""

MAX_LOOK_S = 1.0
"""Most time between two calls of is_hung() that counts: a suspended supervisor reads no reports."""


class HangDetector:
    """Watches the reports of one job. Call is_hung() often."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, starved_s: Callable[[], float] = lambda: 0.0
    ) -> None:
        """starved_s: as of intrasplat/machine/processes.py, of the job's process."""
        self._clock, self._silence = clock, Silence(starved_s)
        self._place: tuple[str, float, int] = ("", 0.0, 0)
        self._looked_s = clock()
        self._silence_s = 0.0

    @property
    def stage(self) -> str:
        """The stage of the last report."""
        return self._place[0]

    def observe(self, progress: JobProgress) -> None:
        """Take a report. It counts as an advance unless it repeats the last one's stage, fraction and iteration."""
        place = (progress.stage, progress.fraction, progress.iteration)
        if place != self._place:
            self._place, self._silence_s = place, 0.0
            self._silence.end()

    def is_hung(self) -> bool:
        """Whether the job has not advanced for longer than its stage allows."""
        now_s = self._clock()
        self._silence_s += min(MAX_LOOK_S, now_s - self._looked_s)
        self._looked_s = now_s
        return self._silence.is_too_long(self._silence_s, STAGE_LIMITS_S.get(self.stage, OTHER_LIMIT_S))
