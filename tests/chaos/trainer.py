"""A stand-in for the device child: obeys worker/orders.py, trains nothing, and is done in half a second."""

from __future__ import annotations

import json
import os
import time
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path

from contract.runtime.settings import Settings
from contract.wire.job import JobProgress
from intrasplat.machine.processes import die_with_parent
from intrasplat.names import CURVE, MANIFEST, REPORT, RESUME
from tests.chaos.points import Point, reach
from tests.reports import REPORT_OF_A_SCENE
from worker.channel import Channel, Orders, Task
from worker.orders import Advanced, Finished, Ready, RunJob, Scored, ScoreScene, Stopped

STEPS = 10
STEPS_MADE = "steps_made"
"""In the scene's manifest: by all attempts whose state it goes on from."""
STEP_S = 0.05
VIEWS = "INTRASPLAT_CHAOS_VIEWS"
"""Set: views are answered, too, by PICTURE."""
PICTURE = b"a picture"


def main() -> None:
    """Obey until the orders end, which ends the process."""
    die_with_parent()
    channel = Channel.instead_of_stdout()
    orders = Orders.from_stdin()
    folder = Settings.from_environment().data_dir / "run"
    endpoint = f"ipc://{folder}/standin-{os.getpid()}"
    with _views(endpoint) if VIEWS in os.environ else nullcontext():
        channel.send(Ready(endpoint=endpoint, device="cpu"))
        _obey(channel, orders)


def _obey(channel: Channel, orders: Orders) -> None:
    while True:
        task = orders.next(60.0)
        if task is not None:
            if isinstance(task.order, RunJob):
                end = _train(task, task.order, channel)
                channel.send(end)
            if isinstance(task.order, ScoreScene) or isinstance(end, Finished):
                reach(Point.SCORING)
                channel.send(Scored(report=REPORT_OF_A_SCENE))


def _views(endpoint: str) -> AbstractContextManager[object]:
    """Answer every render with the same bytes as long as the context lasts."""
    # with OpenCV: too slow a start for who is killed often
    from tests.answers import at_once
    from worker.reply import Reply
    from worker.serve import RequestServer

    return RequestServer(endpoint, at_once(lambda request: Reply(PICTURE, "image/jpeg", 0.0)))


def _train(task: Task, order: RunJob, channel: Channel) -> Finished | Stopped:
    """Make the steps that no earlier attempt has kept; the scene's manifest lists all that were made."""
    made = _kept_steps(order.resume_dir)
    for step in range(len(set(made)), STEPS):
        if task.stop.is_set():
            return Stopped(checkpointed=(order.resume_dir / RESUME).exists())
        time.sleep(STEP_S)
        made.append(step)
        channel.send(Advanced(progress=JobProgress(stage="train", fraction=step / STEPS, iteration=step)))
        _keep(order.resume_dir, made)
        if step == STEPS // 2:
            reach(Point.TRAINING)
    reach(Point.TRAINED)
    _write_scene(order.out, made)
    return Finished()


def _kept_steps(resume_dir: Path) -> list[int]:
    with suppress(FileNotFoundError):
        steps: list[int] = json.loads((resume_dir / RESUME).read_text())
        return steps
    return []


def _keep(resume_dir: Path, made: list[int]) -> None:
    """As intrasplat/train/persistence.py: aside, then in place. It goes on where a later attempt has the folder."""
    aside = resume_dir / f".{RESUME}.new"
    with suppress(FileNotFoundError):
        aside.write_text(json.dumps(made))
        if len(made) == STEPS // 2:
            reach(Point.KEEPING)
        aside.rename(resume_dir / RESUME)


def _write_scene(out: Path, made: list[int]) -> None:
    unscored = REPORT_OF_A_SCENE.model_copy(update={"scored": False})
    (out / REPORT).write_text(unscored.model_dump_json())
    (out / CURVE).write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n")
    (out / MANIFEST).write_text(json.dumps({"files": {}, STEPS_MADE: made}))


if __name__ == "__main__":
    main()
