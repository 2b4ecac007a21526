"""The worker's process: kernels compiled, ear open, announced, then the job loop until it is told to end."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from pathlib import Path

from contract.embedded import short_socket_path
from contract.errors import InputError, UnavailableError
from contract.job import JobRecord
from contract.locks import FolderLock
from contract.queue_redis import RedisQueue
from contract.rendering import WorkerAddress
from contract.settings import Settings
from contract.store import Store
from worker.checkpoint import RESUME_FILE
from worker.consume import announced, consume
from worker.hooks import Hooks
from worker.pipeline import ReconstructionRequest, check_device, reconstruct
from worker.raster.cpu import compile_kernels
from worker.serve import RequestServer
from worker.views import Views

logger = logging.getLogger("intrasplat.worker")


def run_worker(settings: Settings, end: threading.Event) -> None:
    """Work until `end` is set.

    Raises:
        UnavailableError: the queue does not answer, a worker of this name works on this data directory already, or the
            device is not one to train on.
    """
    assert settings.redis_url is not None
    device = training_device(settings.device)
    store = Store(settings.data_dir)
    lock = FolderLock(store.run_dir / f"{settings.worker_name}.lock")
    if not lock.take():
        problem = f"A worker named {settings.worker_name} already works on {store.data_dir}."
        raise UnavailableError(problem, "End it, or set another INTRASPLAT_WORKER_NAME.")
    queue = RedisQueue(settings.redis_url)
    queue.ping()
    started_s = time.monotonic()
    compile_kernels()
    logger.info("kernels are compiled after %.1f s", time.monotonic() - started_s)
    socket_path = short_socket_path(store.run_dir, f"{settings.worker_name}.sock")
    socket_path.unlink(missing_ok=True)  # of an earlier process of this name
    endpoint = f"ipc://{socket_path}"
    address = WorkerAddress(name=settings.worker_name, endpoint=endpoint, device=device)
    # What is unpacked of clips stays in the data directory, and does not outlive the next start.
    tempfile.tempdir = str(store.scratch_folder(settings.worker_name))

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        run_or_start_anew(request_of(record, spool, device), out, hooks)

    with RequestServer(endpoint, Views(store).answer), announced(queue, address):
        logger.info("worker %s is ready on %s", address.name, address.device)
        consume(queue, store, settings.worker_name, work, end)
    queue.close()
    lock.release()


def request_of(record: JobRecord, spool: Path, device: str) -> ReconstructionRequest:
    """The reconstruction that a job asks for, with its files where the store keeps them."""
    files, options = record.files, record.options
    return ReconstructionRequest(
        clip=spool / files.clip,
        right=spool / files.right if files.right else None,
        layout=options.layout,
        calibration=spool / files.calibration if files.calibration else None,
        masks=spool / files.masks if files.masks else None,
        mask_polarity=options.mask_polarity,
        pose_convention=options.pose_convention,
        holdout=options.holdout,
        preset=options.preset,
        budget_s=options.budget_s,
        iterations=options.iterations,
        device=device,
        seed=options.seed,
        accepted_at_s=record.created_at_s,
    )


def run_or_start_anew(request: ReconstructionRequest, out: Path, hooks: Hooks) -> None:
    """Reconstruct; from the beginning if the state in `out` is damaged, or of an earlier version of this program."""
    resumes = (out / RESUME_FILE).exists()
    try:
        reconstruct(request, out, hooks)
    except InputError as error:
        if error.field != "--out" or not resumes:
            raise
        logger.warning("the stored state is of no use to this version; training starts anew")
        (out / RESUME_FILE).unlink()
        reconstruct(request, out, hooks)


def training_device(device: str) -> str:
    """The device that jobs are trained on, where INTRASPLAT_DEVICE is `device`.

    Raises:
        UnavailableError: this version cannot train there.
    """
    try:
        check_device(device)
    except UnavailableError as error:
        raise UnavailableError(error.problem, "Set INTRASPLAT_DEVICE to auto or cpu.") from error
    return "cpu"
