"""A stand-in for the device child: obeys worker/daemon/orders.py, trains nothing, and is done in half a second."""

from __future__ import annotations

import os
import time
from pathlib import Path

from contract.runtime.processes import die_with_parent
from contract.runtime.settings import Settings
from contract.wire.job import JobProgress
from contract.wire.names import CURVE, MANIFEST, REPORT
from tests.chaos.points import Point, reach
from tests.reports import REPORT_OF_A_SCENE
from worker.daemon.channel import Channel, Orders, Task
from worker.daemon.orders import Advanced, Finished, Ready, RunJob, Scored, ScoreScene, Stopped

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
            if isinstance(task.order, RunJob):
                end = _train(task, task.order.out, channel)
                channel.send(end)
            if isinstance(task.order, ScoreScene) or isinstance(end, Finished):
                reach(Point.SCORING)
                channel.send(Scored(report=REPORT_OF_A_SCENE))


def _train(task: Task, out: Path, channel: Channel) -> Finished | Stopped:
    for step in range(STEPS):
        if task.stop.is_set():
            return Stopped(checkpointed=False)
        time.sleep(STEP_S)
        channel.send(Advanced(progress=JobProgress(stage="train", fraction=step / STEPS, iteration=step)))
        if step == STEPS // 2:
            reach(Point.TRAINING)
    _write_scene(out)
    return Finished()


def _write_scene(out: Path) -> None:
    unscored = REPORT_OF_A_SCENE.model_copy(update={"scored": False})
    (out / REPORT).write_text(unscored.model_dump_json())
    (out / CURVE).write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n")
    (out / MANIFEST).write_text('{"files": {}}')


if __name__ == "__main__":
    main()
