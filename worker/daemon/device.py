"""The device process: owns torch, kernels and models, trains one job at a time, and answers renders meanwhile.

It belongs to a supervisor (worker/daemon/supervisor.py), obeys worker/daemon/orders.py, and dies with its supervisor.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from contract.intake.limits import ClipLimits
from contract.queue.embedded import short_socket_path
from contract.runtime.exits import ExitCode, leave_last_words
from contract.runtime.processes import die_with_parent
from contract.runtime.settings import Settings
from contract.store.disk_errors import StoreFullError
from contract.store.results import without_scores
from contract.store.store import Store, open_store
from contract.wire.errors import Cancelled, InputError, ResumeMismatch, UnavailableError
from contract.wire.job import JobProgress, JobRecord
from contract.wire.names import REPORT
from contract.wire.report import Imported, Report
from worker.daemon.channel import Channel, Orders, Task
from worker.daemon.job_errors import describe
from worker.daemon.orders import (
    FETCHING,
    Advanced,
    Failed,
    Finished,
    Holding,
    Ready,
    RunJob,
    Scored,
    ScoreScene,
    Stopped,
    job_progress,
)
from worker.daemon.pace import SHARE, Pace
from worker.daemon.scheduler import Scheduler
from worker.daemon.serve import RequestServer
from worker.daemon.snapshot import Snapshots
from worker.daemon.views import Views
from worker.input.decode import keep_decoder_ready
from worker.instruments import load_segmenter
from worker.machine.hooks import Progress
from worker.pipeline import Made, judge, judge_again, make
from worker.raster.backend import CPU, CPU_BY_VARIABLE, choose_device, examine, gpu_is_lost
from worker.raster.cpu import compile_kernels
from worker.raster.cpu.threads import alone, cpu_time_s, thread_count
from worker.scene.compact import compile_coder
from worker.scene.imported import take_scene
from worker.scene.resume_file import RESUME_FILE
from worker.train.hooks import TrainingHooks
from worker.train.request import ReconstructionRequest

REPORT_PERIOD_S = 0.1
"""Minimum time between two reports of one stage."""

MAX_WAIT_SHARE = 0.4
"""Of the time after which the service gives up a render: who would wait longer is told when to come back."""

MAX_GPU_REST_S = 0.5
"""After a render beside training on a GPU (worker/daemon/pace.py)."""

LAST_SNAPSHOT_S = 10.0
"""How long the last snapshot of a finished job is still shown: until the service knows of the scene."""

logger = logging.getLogger("intrasplat.worker")


def run_device(settings: Settings) -> None:
    """Obey the orders on stdin. It never returns, because the end of the orders ends the process.

    What keeps it from starting (a device, data directory or endpoint that cannot be used) is left to the supervisor
    as last words (contract/runtime/exits.py), and the supervisor tells the user.

    Raises:
        SystemExit: something that it needs is not there.
    """
    die_with_parent()
    channel = Channel.instead_of_stdout()
    orders = Orders.from_stdin()
    try:
        _serve(settings, channel, orders)
    except (UnavailableError, InputError) as error:
        may_return = isinstance(error, StoreFullError)
        if not leave_last_words(UnavailableError(error.problem, error.remedy, may_return=may_return)):
            logger.error("%s", error)
        raise SystemExit(ExitCode.UNAVAILABLE) from error


def _serve(settings: Settings, channel: Channel, orders: Orders) -> None:
    device = choose_device(settings.device, cpu_by=CPU_BY_VARIABLE)
    if settings.segmenter is not None:
        load_segmenter(settings.segmenter)  # says now what every job without masks would fail by
    store, snapshots = open_store(settings), Snapshots()
    pace = Pace(thread_count(), used_s=time.process_time) if device == CPU else Pace(max_debt_s=MAX_GPU_REST_S * SHARE)
    # Clips are unpacked inside the data directory, in a folder that the next start empties.
    tempfile.tempdir = str(store.scratch_folder(settings.worker_name))
    started_s = time.monotonic()
    if device == CPU:
        compile_kernels()
    else:
        examine(device)  # what a job's model needs beside it is compiled for the job
    compile_coder()
    logger.info("the kernels that every job needs are compiled after %.1f s", time.monotonic() - started_s)
    views = Views(store, snapshots, settings.hot_bytes, device)

    def report_held_scenes() -> None:
        views.forget_purged()
        channel.send_if_new(Holding(scenes=views.held))

    endpoint = settings.render_endpoint or _socket_endpoint(store, settings.worker_name)
    scheduler = Scheduler(
        views.answer_in_parts,
        pace,
        cost=views.cost,
        within=lambda: alone(is_alone=pace.trains),  # shares in the pool would make those of a training step wait
        spent_s=cpu_time_s,  # with what this thread waits for a GPU: it asks again and again
        max_wait_s=settings.render_timeout_s * MAX_WAIT_SHARE,
    )
    server = RequestServer(endpoint, scheduler, between=report_held_scenes, render_secret=settings.render_secret)
    with server:
        channel.send(Ready(endpoint=endpoint, device=str(device)))
        logger.info("the device process is ready on %s", device)
        shown = ""
        while True:
            keep_decoder_ready()
            task = orders.next(LAST_SNAPSHOT_S)
            if task is None:
                snapshots.drop(shown)
                continue
            if isinstance(task.order, RunJob):
                shown = task.order.record.job_id
            obey(task, settings, snapshots, pace, channel)


def obey(task: Task, settings: Settings, snapshots: Snapshots, pace: Pace, channel: Channel) -> None:
    """Do what was ordered, and report it."""
    order, limits = task.order, ClipLimits.of(settings)
    if order.record.imported is not None:
        take_in(order, order.record.imported, limits, settings.max_upload_bytes, channel)
        return
    hooks = TrainingHooks(
        on_progress=_Reporter(channel).report,
        should_stop=task.stop.is_set,
        wants_snapshot=snapshots.wanted,
        on_snapshot=snapshots.offer,
        on_first_picture=snapshots.offer_first,
        on_clip=snapshots.offer_clip,
    )
    if isinstance(order, ScoreScene):
        request = request_of(order.record, order.spool, settings.device, limits, settings.segmenter)
        channel.send(scored(lambda: judge_again(request, order.scene, hooks), order.scene / REPORT))
        return
    with pace.training():
        made = work_on(order, settings.device, limits, snapshots, hooks, settings.segmenter)
    if not isinstance(made, Made):
        channel.send(made)
        return
    channel.send(Finished())
    channel.send(scored(lambda: judge(made, hooks), made.report))


def take_in(
    order: RunJob | ScoreScene, imported: Imported, limits: ClipLimits, max_bytes: int, channel: Channel
) -> None:
    """Take in a scene that another installation made; it has its scores."""
    if isinstance(order, ScoreScene):
        report = order.scene / REPORT
        channel.send(scored(lambda: Report.model_validate_json(report.read_bytes()), report))
        return

    def tell(fraction: float) -> None:
        channel.send(Advanced(progress=JobProgress(stage=FETCHING, fraction=fraction)))

    try:
        taken = take_scene(order.spool / order.record.files.clip, order.out, imported, limits, max_bytes, tell)
    except Exception as error:
        channel.send(Failed(error=describe(error), fault=type(error).__name__))
        return
    channel.send(Finished())
    channel.send(Scored(report=taken))


def work_on(
    order: RunJob,
    device: str,
    limits: ClipLimits,
    snapshots: Snapshots,
    hooks: TrainingHooks,
    segmenter: Path | None = None,
) -> Made | Stopped | Failed:
    """Run one job until its scene is finished. An error ends the job; only a lost GPU ends this process too."""
    job_id = order.record.job_id
    snapshots.begin(job_id)
    try:
        request = request_of(order.record, order.spool, device, limits, segmenter)
        return make_or_start_anew(request, order.out, order.kept, hooks)
    except Cancelled:
        snapshots.drop(job_id)
        return Stopped(checkpointed=(order.kept / RESUME_FILE).exists())
    except Exception as error:
        snapshots.drop(job_id)
        if gpu_is_lost():
            logger.error("this process has lost the GPU (%s); another takes its place", type(error).__name__)
            raise SystemExit(1) from error
        return Failed(error=describe(error), fault=type(error).__name__)


def scored(judge: Callable[[], Report], first: Report | Path) -> Scored | Stopped:
    """What judging comes to. An error leaves the scene without scores, and its report says so.

    Stopped: the scene may be scored later, because it was told to stop, something is not available now, or its report
    cannot be read. A lost GPU ends this process.

    first: the report without scores, or its file.
    """
    try:
        return Scored(report=judge())
    except Cancelled:
        return Stopped(checkpointed=False)
    except UnavailableError as error:
        logger.warning("a scene cannot be scored now: %s", error)
        return Stopped(checkpointed=False)
    except Exception as error:
        if gpu_is_lost():
            logger.error("this process has lost the GPU (%s); another takes its place", type(error).__name__)
            raise SystemExit(1) from error
        logger.error("a scene could not be scored: %s", type(error).__name__, exc_info=error)
        try:
            report = first if isinstance(first, Report) else Report.model_validate_json(first.read_bytes())
        except (OSError, ValidationError):  # it was purged, or is damaged
            return Stopped(checkpointed=False)
        return Scored(report=without_scores(report, type(error).__name__))


class _Reporter:
    """Sends progress, not too often; for any thread."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._stage = ""
        self._next_s = 0.0

    def report(self, progress: Progress) -> None:
        """Send the progress if it begins a stage or REPORT_PERIOD_S has passed."""
        now_s = time.monotonic()
        if progress.stage == self._stage and now_s < self._next_s:
            return
        self._stage, self._next_s = progress.stage, now_s + REPORT_PERIOD_S
        self._channel.send(Advanced(progress=job_progress(progress)))


def request_of(
    record: JobRecord, spool: Path, device: str, limits: ClipLimits | None = None, segmenter: Path | None = None
) -> ReconstructionRequest:
    """The request of a job, with its files in the folder where the store keeps them."""
    files = record.files
    return ReconstructionRequest(
        clip=spool / files.clip,
        right=spool / files.right if files.right else None,
        calibration=spool / files.calibration if files.calibration else None,
        masks=spool / files.masks if files.masks else None,
        segmenter=segmenter,
        options=record.options,
        device=device,
        accepted_at_s=record.created_at_s,
        limits=limits,
    )


def make_or_start_anew(request: ReconstructionRequest, out: Path, kept: Path, hooks: TrainingHooks) -> Made:
    """Make the scene, resuming the state in `kept`; start again if that state is damaged or of another version."""
    try:
        return make(request, out, hooks, kept)
    except ResumeMismatch as error:
        logger.warning("training starts again, because the stored state cannot be resumed: %s", error.__cause__)
        (kept / RESUME_FILE).unlink()
        return make(request, out, hooks, kept)


def _socket_endpoint(store: Store, name: str) -> str:
    """A unix socket in the data directory; one that an earlier process of this name left is removed."""
    path = short_socket_path(store.run_dir, f"{name}.sock")
    path.unlink(missing_ok=True)
    return f"ipc://{path}"
