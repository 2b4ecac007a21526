"""The device process: owns torch, kernels and models, trains one job at a time, and answers renders meanwhile.

It belongs to a supervisor (worker/supervisor.py), obeys worker/orders.py, and dies with its supervisor.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from contract.queue.embedded import short_socket_path
from contract.runtime.settings import Settings
from contract.store.store import Store, open_store
from contract.wire.job import JobProgress, JobRecord
from intrasplat.commands.exits import ExitCode, leave_last_words
from intrasplat.decode import keep_decoder_ready
from intrasplat.errors import Cancelled, InputError, ResumeMismatch, UnavailableError
from intrasplat.files.disk_errors import StoreFullError
from intrasplat.instruments import load_segmenter
from intrasplat.intake.limits import ClipLimits
from intrasplat.machine.hooks import Progress
from intrasplat.machine.processes import die_with_parent
from intrasplat.names import POSES_UNUSED, REPORT
from intrasplat.pipeline import Made, make, score_scene, score_stored_scene
from intrasplat.report import Imported, Report
from intrasplat.scene.compact import compile_coder
from intrasplat.scene.imported import take_scene
from intrasplat.scene.results import without_scores
from intrasplat.scene.resume_file import RESUME_FILE
from intrasplat.splat.backend import CPU, CPU_BY_VARIABLE, choose_device, examine, gpu_is_lost
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.cpu.threads import alone, cpu_time_s, thread_count
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from worker.channel import Channel, Orders, Task
from worker.job_errors import describe
from worker.orders import (
    FETCHING,
    Advanced,
    CachedScenes,
    Failed,
    Finished,
    Ready,
    RunJob,
    Scored,
    ScoreScene,
    Stopped,
    job_progress,
)
from worker.pace import SHARE, RenderPace
from worker.scheduler import MAX_WAIT_SHARE, Scheduler
from worker.serve import RequestServer
from worker.snapshot import Snapshots
from worker.views import Views

REPORT_PERIOD_S = 0.1
"""Minimum time between two reports within a stage."""

MAX_GPU_REST_S = 0.5
"""Longest rest after a render beside training on a GPU (worker/pace.py)."""

LAST_SNAPSHOT_S = 10.0
"""How long the last snapshot of a finished job is still rendered: until the service knows the scene."""

logger = logging.getLogger("intrasplat.worker")


def run_device(settings: Settings) -> None:
    """Obey the orders on stdin. It never returns, because the end of the orders ends the process.

    If it cannot start (the device, data directory or endpoint cannot be used), it leaves the error as last words
    (intrasplat/commands/exits.py), which the supervisor shows to the user.

    Raises:
        SystemExit: something that it needs is missing.
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
        load_segmenter(settings.segmenter)  # fails now, not at each job without masks
    store, snapshots = open_store(settings), Snapshots()
    pace = (
        RenderPace(thread_count(), used_s=time.process_time)
        if device == CPU
        else RenderPace(max_debt_s=MAX_GPU_REST_S * SHARE)
    )
    # Clips are unpacked inside the data directory, in a folder that the next start empties.
    tempfile.tempdir = str(store.scratch_folder(settings.worker_name))
    started_s = time.monotonic()
    if device == CPU:
        compile_kernels()
    else:
        examine(device)  # kernels that only a job's model needs are compiled at the job
    compile_coder()
    logger.info("the kernels that every job needs are compiled after %.1f s", time.monotonic() - started_s)
    views = Views(store, snapshots, settings.hot_bytes, device)

    def report_cached_scenes() -> None:
        views.forget_purged()
        channel.send_if_new(CachedScenes(scenes=views.cached))

    endpoint = settings.render_endpoint or _socket_endpoint(store, settings.worker_name)
    scheduler = Scheduler(
        views.answer_in_parts,
        pace,
        cost=views.cost,
        within=lambda: alone(is_alone=pace.trains),  # a render in the thread pool would delay the training step
        spent_s=cpu_time_s,  # includes waiting for a GPU: this thread polls it
        max_wait_s=settings.render_timeout_s * MAX_WAIT_SHARE,
    )
    server = RequestServer(endpoint, scheduler, between=report_cached_scenes, render_secret=settings.render_secret)
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


def obey(task: Task, settings: Settings, snapshots: Snapshots, pace: RenderPace, channel: Channel) -> None:
    """Carry out an order, and report its end."""
    order, limits = task.order, settings.clip_limits
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
        channel.send(scored(lambda: score_stored_scene(request, order.scene, hooks), order.scene / REPORT))
        return
    with pace.training():
        made = work_on(order, settings.device, limits, snapshots, hooks, settings.segmenter)
    if not isinstance(made, Made):
        channel.send(made)
        return
    channel.send(Finished())
    channel.send(scored(lambda: score_scene(made, hooks), made.report))


def take_in(
    order: RunJob | ScoreScene, imported: Imported, limits: ClipLimits, max_bytes: int, channel: Channel
) -> None:
    """Import a scene of another installation, which has its scores already."""
    if isinstance(order, ScoreScene):
        report = order.scene / REPORT
        channel.send(scored(lambda: Report.model_validate_json(report.read_bytes()), report))
        return

    def report_fraction(fraction: float) -> None:
        channel.send(Advanced(progress=JobProgress(stage=FETCHING, fraction=fraction)))

    try:
        taken = take_scene(
            order.spool / order.record.files.clip, order.out, imported, limits, max_bytes, report_fraction
        )
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
    """Run one job until its scene is finished. An error ends only the job; a lost GPU ends this process, too."""
    job_id = order.record.job_id
    snapshots.begin(job_id)
    try:
        request = request_of(order.record, order.spool, device, limits, segmenter)
        return make_or_start_anew(request, order.out, order.resume_dir, hooks)
    except Cancelled:
        snapshots.drop(job_id)
        return Stopped(checkpointed=(order.resume_dir / RESUME_FILE).exists())
    except Exception as error:
        snapshots.drop(job_id)
        exit_if_gpu_is_lost(error)
        return Failed(error=describe(error), fault=type(error).__name__)


def scored(score: Callable[[], Report], first: Report | Path) -> Scored | Stopped:
    """The result of scoring a scene. After an error the scene has no scores, and its report says so.

    Stopped: the scene may be scored later, because of an order to stop, because something is not available now, or
    because its report cannot be read. A lost GPU ends this process.

    first: the report without scores, or its file.
    """
    try:
        return Scored(report=score())
    except Cancelled:
        return Stopped(checkpointed=False)
    except UnavailableError as error:
        logger.warning("a scene cannot be scored now: %s", error)
        return Stopped(checkpointed=False)
    except Exception as error:
        exit_if_gpu_is_lost(error)
        logger.error("a scene could not be scored: %s", type(error).__name__, exc_info=error)
        try:
            report = first if isinstance(first, Report) else Report.model_validate_json(first.read_bytes())
        except (OSError, ValidationError):  # it was purged, or is damaged
            return Stopped(checkpointed=False)
        return Scored(report=without_scores(report, type(error).__name__))


def exit_if_gpu_is_lost(error: Exception) -> None:
    """End this process if it has lost the GPU, which only another process can use again.

    Raises:
        SystemExit: the GPU is lost.
    """
    if gpu_is_lost():
        logger.error("this process has lost the GPU (%s); another takes its place", type(error).__name__)
        raise SystemExit(1) from error


class _Reporter:
    """Sends progress at a limited rate; any thread may use it."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._stage = ""
        self._next_s = 0.0

    def report(self, progress: Progress) -> None:
        """Send the progress if a new stage starts or REPORT_PERIOD_S has passed."""
        now_s = time.monotonic()
        if progress.stage == self._stage and now_s < self._next_s:
            return
        self._stage, self._next_s = progress.stage, now_s + REPORT_PERIOD_S
        self._channel.send(Advanced(progress=job_progress(progress)))


def request_of(
    record: JobRecord, spool: Path, device: str, limits: ClipLimits | None = None, segmenter: Path | None = None
) -> ReconstructionRequest:
    """The reconstruction request of a job, with its files in the folder `spool`.

    The field of view and the poses that came with an earlier job of the same clip are left out if the options of this
    one do not use them.
    """
    files = record.files
    return ReconstructionRequest(
        clip=spool / files.clip,
        right=spool / files.right if files.right else None,
        calibration=spool / files.calibration if files.calibration else None,
        masks=spool / files.masks if files.masks else None,
        fov_mask=spool / files.fov_mask if files.fov_mask and record.options.fov != "all" else None,
        poses=spool / files.poses_file if files.poses_file and record.options.poses not in POSES_UNUSED else None,
        segmenter=segmenter,
        options=record.options,
        device=device,
        accepted_at_s=record.created_at_s,
        limits=limits,
    )


def make_or_start_anew(request: ReconstructionRequest, out: Path, resume_dir: Path, hooks: TrainingHooks) -> Made:
    """Train the scene, resuming the state in `resume_dir`; start again if it is damaged or of another version."""
    try:
        return make(request, out, hooks, resume_dir)
    except ResumeMismatch as error:
        logger.warning("training starts again, because the stored state cannot be resumed: %s", error.__cause__)
        (resume_dir / RESUME_FILE).unlink()
        return make(request, out, hooks, resume_dir)


def _socket_endpoint(store: Store, name: str) -> str:
    """The endpoint of a unix socket in the data directory; the socket of an earlier process of this name is removed."""
    path = short_socket_path(store.run_dir, f"{name}.sock")
    path.unlink(missing_ok=True)
    return f"ipc://{path}"
