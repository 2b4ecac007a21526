"""Score a finished model: compare its renders with the frames of its clip."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from intrasplat.clip import DepthClip, Eye
from intrasplat.errors import Cancelled
from intrasplat.machine.cores import cores
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.quality.baselines import copy_baselines
from intrasplat.quality.detail import measure_detail
from intrasplat.quality.report import measure, scored_report
from intrasplat.quality.right_eye import measure_right
from intrasplat.report import Report
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.scoring import FrameRenderer, Mapping, PoseRenderer, sample_frames

STAGE = "score"


def score_model(
    first: Report,
    clip: DepthClip,
    train: Sequence[int],
    render: PoseRenderer,
    hooks: Hooks,
    detailed: PoseRenderer | None = None,
) -> Report:
    """The report with the scores of the model's held-out frames, of the right eye's, and of the copy baselines.

    Args:
        first: the report of the model before it was scored.
        train: the frames that the model was trained on.
        render: renders the model; several threads may call it.
        detailed: the same with detail from recorded frames; None: they are not kept.

    Raises:
        TrainingDiverged: a render contains NaN or infinity.
        Cancelled: hooks.should_stop said so.
    """
    started_s, sampled = time.perf_counter(), sample_frames(train)
    total, done = (2 if detailed is None else 4) * len(first.held_out) + len(sampled), 0

    def views(eye: DepthClip | Eye, render: PoseRenderer = render) -> FrameRenderer:
        """A function that renders the frame with an index from the eye's own pose."""

        def view(index: int) -> RenderedFrame:
            nonlocal done
            hooks.on_progress(Progress(STAGE, done / total, first.iterations, first.iterations))
            done += 1
            return render(float(clip.t[index]), eye.world_from_camera[index], eye.intrinsics)

        return view

    with (
        one_opencv_thread(),
        ThreadPoolExecutor(cores(), thread_name_prefix=STAGE) as pool,
        ThreadPoolExecutor(1) as beside,
    ):
        each = _until_stopped(pool, hooks)
        copied = beside.submit(copy_baselines, clip, train, first.held_out, each)
        held_out = measure(clip, first.held_out, views(clip), each)
        right = measure_right(clip, first.held_out, views(clip.right or clip), each)
        trained = measure(clip, sampled, views(clip), each, compared=not first.held_out)
        detail = None
        if detailed is not None:
            left_views, right_views = views(clip, detailed), views(clip.right or clip, detailed)
            detail = measure_detail(clip, first.held_out, left_views, right_views, each)
        baselines = copied.result()
    report = scored_report(first, held_out, right, trained, baselines, detail)
    made, left_db, right_db = first.iterations, report.psnr_tissue_db, report.psnr_right_db
    hooks.on_progress(Progress(STAGE, 1.0, made, made, psnr_db=left_db, psnr_right_db=right_db))
    return report.model_copy(update={"seconds": {**first.seconds, "score_s": time.perf_counter() - started_s}})


def _until_stopped(pool: ThreadPoolExecutor, hooks: Hooks) -> Mapping:
    """The pool's map; its work raises Cancelled as soon as hooks.should_stop says so."""

    def each(work: Callable[[int], Any], frames: Iterable[int]) -> Iterable[Any]:
        def unless_stopped(index: int) -> Any:
            if hooks.should_stop():
                raise Cancelled("Stopped while scoring.")
            return work(index)

        return pool.map(unless_stopped, frames)

    return each
