"""A stand-in for the device child: obeys worker/daemon/orders.py, trains nothing, and is done in half a second."""

from __future__ import annotations

import os
import time
from pathlib import Path

from contract.runtime.processes import die_with_parent
from contract.runtime.settings import Settings
from contract.wire.job import JobProgress
from contract.wire.names import MANIFEST, REPORT
from tests.chaos.points import Point, reach
from tests.reports import REPORT_OF_A_SCENE
from worker.daemon.channel import Channel, Orders, Task
from worker.daemon.orders import Advanced, Finished, Ready, Stopped

STEPS = 10
STEP_S = 0.05


def main() -> None:
    """Obey until the orders end, which ends the process."""
    die_with_parent()
    channel = Channel.instead_of_stdout()
    orders = Orders.from_stdin()
    folder = Settings.from_environment().data_dir / "run"
    channel.send(Ready(endpoint=f"ipc://{folder}/standin-{os.getpid()}", device="cpu"))
    while True:
        task = orders.next(60.0)
        if task is not None:
            channel.send(_train(task, channel))


def _train(task: Task, channel: Channel) -> Finished | Stopped:
    for step in range(STEPS):
        if task.stop.is_set():
            return Stopped(checkpointed=False)
        time.sleep(STEP_S)
        channel.send(Advanced(progress=JobProgress(stage="train", fraction=step / STEPS, iteration=step)))
        if step == STEPS // 2:
            reach(Point.TRAINING)
    _write_scene(task.run.out)
    return Finished()


def _write_scene(out: Path) -> None:
    (out / REPORT).write_text(REPORT_OF_A_SCENE.model_dump_json())
    (out / MANIFEST).write_text("{}")


if __name__ == "__main__":
    main()
