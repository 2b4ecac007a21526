"""Snapshots: callers get the newest, no copy is made without a caller, and watching changes no bit of training."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from contract.store.store import Store
from contract.wire.rendering import RenderRequest
from intrasplat.machine.hooks import Progress
from intrasplat.machine.timing import Stopwatch
from intrasplat.options import ReconstructionOptions
from intrasplat.outcome import snapshot_of
from intrasplat.picture import ImageFormat
from intrasplat.pipeline import reconstruct
from intrasplat.scene.checkpoint import SCENE_FILE
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.run import Run
from intrasplat.train.scoring import HeldOutScore
from intrasplat.view.render import render_frame
from lab.evaluate.variants import register_variants
from lab.phantom import PhantomSettings, make_phantom, write_endonerf
from tests.intrasplat.phantoms import bits, phantom_clip, prepared, view
from tests.intrasplat.scenes import random_scene
from worker.reply import NotYetError
from worker.snapshot import Snapshots
from worker.views import Views

JOB, OTHER = "0" * 32, "1" * 32
ITERATIONS = 16
ALWAYS, NEVER = 0.0, 1e9


def hooks_of(snapshots: Snapshots) -> TrainingHooks:
    return TrainingHooks(wants_snapshot=snapshots.wanted, on_snapshot=snapshots.offer)


def trained_with(run: Run, copy_scene: Callable[[], TrainedScene], hooks: TrainingHooks) -> Run:
    train(run, Stopwatch(), lambda: HeldOutScore(math.nan, math.nan), hooks, copy_scene)
    return run


@contextmanager
def watching(snapshots: Snapshots, store: Store) -> Iterator[list[bytes]]:
    """Somebody who asks for one picture after the other, in a thread of their own."""
    views, seen, end = Views(store, snapshots), list[bytes](), threading.Event()

    def watch() -> None:
        while not end.is_set():
            try:
                request = RenderRequest(scene_id=JOB, t=0.5, format=ImageFormat.NPY)
                seen.append(views.answer(request).body)
            except NotYetError:
                end.wait(0.001)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield seen
    finally:
        end.set()
        thread.join()


@pytest.mark.parametrize("preset", ["fast", "paper", "hexplane"])
def test_a_watched_run_comes_to_the_bits_of_an_unwatched_one(preset: str, tmp_path: Path) -> None:
    register_variants()
    clip = phantom_clip()
    alone, _ = prepared(clip, preset, iterations=ITERATIONS)
    trained_with(alone, lambda: snapshot_of(alone), TrainingHooks())
    watched, _ = prepared(clip, preset, iterations=ITERATIONS)
    snapshots = Snapshots(period_s=ALWAYS)
    snapshots.begin(JOB)
    with watching(snapshots, Store(tmp_path)) as seen:
        trained_with(watched, lambda: snapshot_of(watched), hooks_of(snapshots))
    newest = snapshots.newest(JOB)
    assert newest is not None
    assert newest.iteration > 0
    assert len(set(seen)) > 1
    assert bits(watched) == bits(alone)


def test_a_reconstruction_can_be_watched_from_its_clip_to_its_scene(tmp_path: Path) -> None:
    write_endonerf(make_phantom(PhantomSettings(width=96, height=80, frames=10, period_frames=12)), tmp_path / "clip")
    request = ReconstructionRequest(tmp_path / "clip", ReconstructionOptions(iterations=ITERATIONS))
    snapshots, stages = Snapshots(period_s=ALWAYS), set[str]()
    snapshots.begin(JOB)

    def note(progress: Progress) -> None:
        if snapshots.newest(JOB) is not None:
            stages.add(progress.stage)

    hooks = TrainingHooks(on_progress=note, wants_snapshot=snapshots.wanted, on_snapshot=snapshots.offer)
    reconstruct(request, tmp_path / "watched", hooks)
    reconstruct(request, tmp_path / "alone", TrainingHooks())
    newest = snapshots.newest(JOB)
    assert newest is not None
    assert {"train", "score"} <= stages <= {"train", "finish", "score"}
    first, second = ((tmp_path / each / SCENE_FILE).read_bytes() for each in ("watched", "alone"))
    assert first == second


def test_a_run_that_nobody_watches_is_not_copied() -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=4)
    snapshots, copies = Snapshots(period_s=ALWAYS), list[int]()

    def copy() -> TrainedScene:
        copies.append(run.iteration)
        return snapshot_of(run)

    snapshots.begin(JOB)
    trained_with(run, copy, hooks_of(snapshots))
    assert copies == []


def test_a_snapshot_shows_what_the_model_shows_and_training_does_not_move_it() -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=4)
    scene = snapshot_of(run)
    before, t = view(run, 3), float(clip.t[3])
    trained_with(run, lambda: scene, TrainingHooks())
    frame = render_frame(scene, t, detail="off")
    np.testing.assert_allclose(frame.rgb / 255.0, np.clip(before.rgb, 0, 1), atol=0.51 / 255)
    assert not np.array_equal(view(run, 3).rgb, before.rgb)


def test_a_copy_is_wanted_by_who_asks_for_it_alone() -> None:
    snapshots = Snapshots(period_s=ALWAYS, patience_s=0.0)
    assert not snapshots.wanted()
    snapshots.begin(JOB)
    assert not snapshots.wanted()
    assert snapshots.newest(JOB) is None
    assert snapshots.wanted()
    snapshots.offer(random_scene(), 0)
    assert not snapshots.wanted()
    snapshots.newest(OTHER)
    assert not snapshots.wanted()
    snapshots.newest(JOB)
    assert snapshots.wanted()


def test_a_copy_that_is_young_is_shown_again() -> None:
    snapshots = Snapshots(period_s=NEVER)
    snapshots.begin(JOB)
    snapshots.offer(random_scene(), 0)
    assert snapshots.newest(JOB) is snapshots.newest(JOB)
    assert not snapshots.wanted()


def test_who_asks_when_a_copy_is_due_is_given_that_one() -> None:
    snapshots = Snapshots(period_s=ALWAYS, patience_s=30.0)
    snapshots.begin(JOB)
    snapshots.offer(random_scene(), 0)
    loop = threading.Thread(target=lambda: offer_when_wanted(snapshots, 7))
    loop.start()
    newest = snapshots.newest(JOB)
    loop.join()
    assert newest is not None
    assert newest.iteration == 7


def offer_when_wanted(snapshots: Snapshots, iteration: int) -> None:
    while not snapshots.wanted():
        threading.Event().wait(0.001)
    snapshots.offer(random_scene(), iteration)


def test_a_loop_that_does_something_else_is_waited_for_once() -> None:
    snapshots = Snapshots(period_s=ALWAYS, patience_s=0.01)
    snapshots.begin(JOB)
    snapshots.offer(random_scene(), 3)
    first = snapshots.newest(JOB)
    assert first is not None
    assert first.iteration == 3
    assert snapshots.newest(JOB) is first


def test_what_a_job_has_shown_ends_with_it() -> None:
    snapshots = Snapshots()
    snapshots.begin(JOB)
    snapshots.offer(random_scene(), 0)
    snapshots.drop(OTHER)
    assert snapshots.newest(JOB) is not None
    snapshots.begin(OTHER)
    assert snapshots.newest(JOB) is None
    assert snapshots.newest(OTHER) is None
    snapshots.offer(random_scene(), 0)
    snapshots.drop(OTHER)
    assert snapshots.newest(OTHER) is None
    snapshots.offer(random_scene(), 5)  # the loop has not heard of it yet
    assert snapshots.newest(OTHER) is None
