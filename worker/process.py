"""The worker's process: kernels compiled, ear open, announced, then the job loop until it is told to end."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import torch

from contract.embedded import short_socket_path
from contract.errors import UnavailableError
from contract.job import JobRecord
from contract.locks import FolderLock
from contract.queue_redis import RedisQueue
from contract.rendering import WorkerAddress
from contract.settings import Settings
from contract.store import Store
from worker.consume import announced, consume
from worker.hooks import Hooks
from worker.pipeline import ReconstructionRequest, reconstruct
from worker.raster.cpu import compile_kernels
from worker.serve import RequestServer
from worker.views import Views

logger = logging.getLogger("intrasplat.worker")


def run_worker(settings: Settings, end: threading.Event) -> None:
    """Work until `end` is set.

    Raises:
        UnavailableError: the queue does not answer, or a worker of this name works on this data directory already.
    """
    assert settings.redis_url is not None
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
    address = WorkerAddress(name=settings.worker_name, endpoint=endpoint, device=device_name(settings.device))

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        reconstruct(request_of(record, spool, settings.device), out, hooks)

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


def device_name(device: str) -> str:
    """The device that `auto` means here."""
    return "cuda" if device == "cuda" or (device == "auto" and torch.cuda.is_available()) else "cpu"
