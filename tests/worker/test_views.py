"""Renders of stored scenes: the requested camera, and no picture of a scene that is gone."""
# long: every picture, measurement and file that views of one store answer

from __future__ import annotations

import dataclasses
import io
import itertools
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest, SceneCameras
from contract.wire.rendering import TYPICAL_GAUSSIANS, TYPICAL_SIZE, RenderRequest, render_cost
from intrasplat.camera import Intrinsics
from intrasplat.errors import LimitError, SceneError
from intrasplat.machine.parts import Parts
from intrasplat.notices import NoticeCode
from intrasplat.picture import Highlights, ImageFormat, IntrinsicsOverride, Layer, Unseen
from intrasplat.pose import parse_pose
from intrasplat.scene.checkpoint import save_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.cpu.rasterizer import Rasterizer
from intrasplat.splat.deformation import GaussianFdm
from intrasplat.splat.gaussians import Gaussians
from intrasplat.view.camera import camera_of, pose_of
from intrasplat.view.render import clamped_to_clip
from tests.worker.exports import export_request, exported
from worker import rendered as rendered_module
from worker.reply import NotYetError, Reply
from worker.snapshot import Snapshots
from worker.views import COPIES, Views

CLIP = Intrinsics(width=64, height=48, fx=60, fy=60, cx=32, cy=24)
FRAMES = 10
UNITS_PER_MM = 1.5
MAX_PIXELS = 10_000


def scene() -> TrainedScene:
    """A flat sheet of Gaussians at the median depth."""
    across, down = torch.meshgrid(torch.linspace(-25, 25, 12), torch.linspace(-20, 20, 10), indexing="ij")
    mean = torch.stack([across.flatten(), down.flatten(), torch.full((120,), 60.0)], dim=1)
    gaussians = Gaussians(
        mean=mean,
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(120, 1),
        log_scale=torch.full((120, 3), 1.0),
        opacity_logit=torch.full((120,), 3.0),
        sh=torch.rand(120, 1, 3, generator=torch.Generator().manual_seed(0)),
    )
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    return TrainedScene(
        gaussians=gaussians,
        deformation=GaussianFdm.initial(len(gaussians)),
        intrinsics=CLIP,
        world_from_camera=poses,
        frame_times_s=np.arange(FRAMES) / 25,
        units_per_mm=UNITS_PER_MM,
        preset="fast",
        trained_t=tuple(i / FRAMES for i in range(FRAMES)),
        seen=torch.ones(120),
    )


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


@pytest.fixture
def scene_id(store: Store) -> str:
    job_id = new_job_id()
    publish(store, job_id)
    return job_id


def publish(store: Store, job_id: str, attempt: int = 1, *, dimmed: float = 0.0, gloss: float = 0.0) -> TrainedScene:
    """A stored scene; its colours are dimmed by so much, so that attempts can be told apart.

    gloss: of every Gaussian; unless it is 0 both eyes taught.
    """
    made = scene()
    made.gaussians.sh.sub_(dimmed)
    if gloss:
        made.gaussians.gloss.add_(gloss)
        made = dataclasses.replace(made, right_eye_mm=(4.0, 0.0, 0.0))
    save_scene(store.work_folder(job_id, attempt), made)
    store.publish_scene(job_id, attempt)
    return made


def request_of(scene_id: str, attempt: int | None = 1, t: float = 0.0) -> RenderRequest:
    return RenderRequest(scene_id=scene_id, attempt=attempt, t=t, format=ImageFormat.NPY)


def test_a_stored_scene_is_rendered_at_the_size_of_the_clip(store: Store, scene_id: str) -> None:
    view = Views(store).answer(
        RenderRequest(scene_id=scene_id, attempt=1, t=0.25, layer=Layer.DEPTH, format=ImageFormat.NPY)
    )
    assert view.media_type == "application/x-npy"
    assert view.t == 0.25
    depth_mm = np.load(io.BytesIO(view.body))
    assert depth_mm.shape == (CLIP.height, CLIP.width)
    assert np.median(depth_mm[depth_mm > 0]) == pytest.approx(60 / UNITS_PER_MM, rel=0.05)


def test_depth_in_false_colours_says_between_which_depths_and_says_the_same_at_every_time(
    store: Store, scene_id: str
) -> None:
    views, asked = Views(store), request_of(scene_id).model_copy(update={"layer": Layer.DEPTH})
    false_colours = asked.model_copy(update={"format": ImageFormat.JPEG})
    ranges = {views.answer(false_colours.model_copy(update={"t": t})).depth_range_mm for t in (0.0, 0.3, 0.9)}
    assert len(ranges) == 1
    near_mm, far_mm = ranges.pop() or (0.0, 0.0)
    assert near_mm <= 60 / UNITS_PER_MM <= far_mm
    assert views.answer(asked).depth_range_mm is None


def test_a_render_tells_its_camera(store: Store, scene_id: str) -> None:
    from_near = request_of(scene_id, t=1.0).model_copy(
        update={"pose": parse_pose("orbit:0,0,2"), "camera": IntrinsicsOverride(width=2 * CLIP.width)}
    )
    reply = Views(store).answer(from_near)
    assert reply.camera is not None
    assert (reply.camera.width, reply.camera.fx, reply.camera.cy) == (2 * CLIP.width, 2 * CLIP.fx, 2 * CLIP.cy)
    assert reply.camera.world_from_camera[11] == pytest.approx(60 / UNITS_PER_MM / 2)
    own = Views(store).answer(request_of(scene_id, t=1.0)).camera
    assert own is not None
    assert own.world_from_camera == tuple(scene().world_from_camera[-1, :3].flatten())


def test_a_time_after_the_clip_shows_its_last_frame_and_warns(store: Store, scene_id: str) -> None:
    view = Views(store).answer(request_of(scene_id, t=3))
    assert view.t == (FRAMES - 1) / FRAMES
    assert view.warnings


def test_a_render_marks_what_no_frame_saw_unless_it_is_asked_to_guess(store: Store, scene_id: str) -> None:
    aside = request_of(scene_id).model_copy(update={"pose": parse_pose("orbit:30,0,1")})
    marked, guessed = (Views(store).answer(aside.model_copy(update={"unseen": each})) for each in Unseen)
    assert marked.unseen == guessed.unseen > 0.05
    assert NoticeCode.UNSEEN in [each.code for each in marked.warnings]
    differs = (np.load(io.BytesIO(marked.body)) != np.load(io.BytesIO(guessed.body))).any(-1)
    assert 0.9 * marked.unseen < differs.mean() <= marked.unseen


@pytest.mark.parametrize("layer", [each for each in Layer if each is not Layer.ERROR])
def test_only_colours_are_shown_without_highlights(store: Store, layer: Layer) -> None:
    job_id = new_job_id()
    publish(store, job_id, gloss=-0.2)  # seen by the left eye
    request = request_of(job_id).model_copy(update={"layer": layer})
    on, off = (Views(store).answer(request.model_copy(update={"highlights": each})) for each in Highlights)
    assert on.warnings == off.warnings
    assert (on.body != off.body) == (layer is Layer.RGB)


@pytest.mark.parametrize("layer", [each for each in Layer if each is not Layer.ERROR])
def test_highlights_that_are_not_known_apart_stay_and_the_render_says_so(
    store: Store, scene_id: str, layer: Layer
) -> None:
    request = request_of(scene_id).model_copy(update={"layer": layer})
    on, off = (Views(store).answer(request.model_copy(update={"highlights": each})) for each in Highlights)
    assert on.body == off.body
    added = [each.code for each in off.warnings if each not in on.warnings]
    assert added == [NoticeCode.HIGHLIGHTS_UNKNOWN] * (layer is Layer.RGB)


def test_a_deleted_scene_is_not_shown_from_memory(store: Store, scene_id: str) -> None:
    views = Views(store)
    views.answer(request_of(scene_id))
    shutil.rmtree(store.scene_folder(scene_id, 1))
    with pytest.raises(SceneError):
        views.answer(request_of(scene_id))
    assert views.cached == ()


def test_a_deleted_scene_leaves_memory_without_a_request(store: Store, scene_id: str) -> None:
    views, other = Views(store), new_job_id()
    publish(store, other)
    views.answer(request_of(scene_id))
    views.answer(request_of(other))
    store.purge(scene_id)
    views.forget_purged()
    assert views.cached == (other,)


def test_the_attempt_that_is_named_is_shown(store: Store, scene_id: str) -> None:
    views = Views(store)
    first = views.answer(request_of(scene_id, attempt=1)).body
    publish(store, scene_id, attempt=2, dimmed=0.4)
    assert views.answer(request_of(scene_id, attempt=2)).body != first
    assert views.answer(request_of(scene_id, attempt=1)).body == first
    with pytest.raises(SceneError):
        views.answer(request_of(scene_id, attempt=3))


def test_no_more_scenes_are_held_than_their_bytes_allow_and_the_one_used_longest_ago_goes(store: Store) -> None:
    scene_ids = [new_job_id() for _ in range(4)]
    size = max(publish(store, each).byte_count for each in scene_ids)
    views = Views(store, hot_bytes=COPIES * size * 3)
    for each in (*scene_ids[:3], scene_ids[0], scene_ids[3]):
        views.answer(request_of(each))
    assert views.cached == (scene_ids[2], scene_ids[0], scene_ids[3])


def test_a_scene_larger_than_all_that_may_be_held_is_shown(store: Store, scene_id: str) -> None:
    views = Views(store, hot_bytes=1)
    assert views.answer(request_of(scene_id)).body
    assert views.cached == (scene_id,)


def test_a_running_job_is_shown_by_its_snapshot_which_vouches_for_nothing(store: Store, scene_id: str) -> None:
    snapshots = Snapshots()
    views = Views(store, snapshots)
    running = new_job_id()
    snapshots.begin(running)
    with pytest.raises(NotYetError):
        views.answer(request_of(running, attempt=None))
    snapshots.offer_first(dataclasses.replace(scene(), seen=torch.zeros(120)))
    first = views.answer(request_of(running, attempt=None))
    assert first.iteration == 0
    assert [each.code for each in first.warnings] == [NoticeCode.FIRST_PICTURE, NoticeCode.UNSEEN]
    assert snapshots.wanted()  # the start of training takes its place
    snapshots.offer(dataclasses.replace(scene(), seen=torch.zeros(120)), 40)
    view = views.answer(request_of(running, attempt=None))
    assert view.iteration == 40
    assert [each.code for each in view.warnings] == [NoticeCode.TRAINING_GOES_ON, NoticeCode.UNSEEN]  # bare borders
    layer = RenderRequest(scene_id=running, t=0, layer=Layer.CONFIDENCE, format=ImageFormat.NPY)
    assert not np.load(io.BytesIO(views.answer(layer).body)).any()
    assert views.answer(request_of(scene_id)).iteration is None


def test_cameras_are_those_of_the_scene_or_of_the_snapshot(store: Store) -> None:
    stored = new_job_id()
    made = publish(store, stored, gloss=0.1)
    snapshots, running = Snapshots(), new_job_id()
    snapshots.begin(running)
    views = Views(store, snapshots)
    with pytest.raises(NotYetError):
        views.answer(CamerasRequest(scene_id=running))
    snapshots.offer_first(made)
    of_done, of_running = CamerasRequest(scene_id=stored, attempt=1), CamerasRequest(scene_id=running)
    for request, iteration in ((of_done, None), (of_running, 0)):
        reply = views.answer(request)
        cameras = SceneCameras.model_validate_json(reply.body)
        assert (reply.media_type, reply.iteration, views.cost(request)) == ("application/json", iteration, 0.0)
        assert Intrinsics.parsed(cameras.intrinsics.model_dump()) == CLIP
        np.testing.assert_array_equal(cameras.world_from_camera, made.world_from_camera)
        np.testing.assert_array_equal(cameras.frame_times_s, made.frame_times_s)
        assert (cameras.units_per_mm, cameras.right_eye_mm) == (UNITS_PER_MM, (4.0, 0.0, 0.0))
        assert cameras.trained_t == made.trained_t


def test_a_finished_scene_is_not_taken_for_a_running_job(store: Store, scene_id: str) -> None:
    with pytest.raises(NotYetError):
        Views(store).answer(request_of(scene_id, attempt=None))


def test_an_export_holds_every_gaussian(store: Store, scene_id: str) -> None:
    view, content = exported(Views(store).answer, export_request(scene_id, t=0.5))
    assert b"element vertex 120\n" in content
    assert (view.t, view.warnings) == (0.5, ())


def test_an_export_after_the_clip_is_of_its_last_frame_and_says_so(store: Store, scene_id: str) -> None:
    view, content = exported(Views(store).answer, export_request(scene_id, t=1))
    last, same = exported(Views(store).answer, export_request(scene_id, t=(FRAMES - 1) / FRAMES))
    assert view.t == last.t == (FRAMES - 1) / FRAMES
    assert content == same
    assert view.warnings
    assert not last.warnings


def test_an_orbit_turns_about_the_median_depth() -> None:
    still = pose_of(scene(), parse_pose("orbit:0,0,1"))
    nearer = pose_of(scene(), parse_pose("orbit:0,0,2"))
    assert still is not None
    assert nearer is not None
    np.testing.assert_array_equal(still, np.eye(4))
    assert nearer[2, 3] == pytest.approx(60 / UNITS_PER_MM / 2)
    assert pose_of(scene(), None) is None


def test_time_is_clamped_to_the_last_frame() -> None:
    assert clamped_to_clip(scene(), 0.3)[0] == 0.3
    assert clamped_to_clip(scene(), 1.0)[0] == 0.9


def test_one_side_given_keeps_the_aspect_and_the_field_of_view() -> None:
    assert camera_of(CLIP, IntrinsicsOverride(width=128), MAX_PIXELS * 9) == CLIP.resized(128, 96)
    assert camera_of(CLIP, IntrinsicsOverride(height=24), MAX_PIXELS) == CLIP.resized(32, 24)
    assert camera_of(CLIP, IntrinsicsOverride(), MAX_PIXELS) == CLIP


def test_focal_length_and_centre_are_taken_as_given() -> None:
    camera = camera_of(CLIP, IntrinsicsOverride(width=32, fx=99, cy=1), MAX_PIXELS)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (99, 30, 16, 1)


def test_an_image_over_the_limit_is_refused() -> None:
    with pytest.raises(LimitError, match="more than 10000 pixels"):
        camera_of(CLIP, IntrinsicsOverride(width=200), MAX_PIXELS)


def test_who_asks_the_same_again_gets_the_same_answer_until_the_scene_or_the_snapshot_is_another(
    store: Store, scene_id: str
) -> None:
    snapshots = Snapshots(period_s=0.0, patience_s=0.0)
    views, running = Views(store, snapshots), new_job_id()
    snapshots.begin(running)
    for request in (request_of(scene_id), request_of(running, attempt=None)):
        snapshots.offer(scene(), 40)
        first, again = views.answer(request), views.answer(request)
        assert (first.is_untimed, again.is_untimed, again.body) == (False, True, first.body)
        assert views.cost(request) == 0
    snapshots.offer(scene(), 41)
    assert views.answer(request).iteration == 41
    store.purge(scene_id)
    with pytest.raises(SceneError):
        views.answer(request_of(scene_id))
    assert views.cost(request_of(scene_id)) > 0


def made_with(parts: Parts[Reply], between: Callable[[int], None]) -> Reply:
    """The reply; between is called after each part but the last, with its number."""
    for number in itertools.count(1):
        try:
            next(parts)
        except StopIteration as end:
            reply: Reply = end.value
            return reply
        between(number)
    raise AssertionError


def large_of(request: RenderRequest, **changes: object) -> RenderRequest:
    return request.model_copy(update={"camera": IntrinsicsOverride(width=1600, height=1200), **changes})


def test_between_the_parts_of_a_large_render_others_of_the_same_scene_are_made_to_the_same_bits(
    store: Store, scene_id: str
) -> None:
    large, small = large_of(request_of(scene_id)), request_of(scene_id, t=0.5)
    as_large = large.model_copy(update={"t": 0.25})
    alone = [Views(store).answer(each).body for each in (large, small, as_large)]
    views, between = Views(store), list[bytes]()

    def look(number: int) -> None:
        if number == 2:
            between.extend(views.answer(each).body for each in (small, as_large))

    assert [made_with(views.answer_in_parts(large), look).body, *between] == alone


def test_a_large_render_has_many_parts_and_can_be_abandoned_between_any_two(store: Store, scene_id: str) -> None:
    views, numbers = Views(store), list[int]()
    large = large_of(request_of(scene_id), layer=Layer.CONFIDENCE, format=ImageFormat.JPEG)
    whole = made_with(views.answer_in_parts(large), numbers.append)
    assert len(numbers) > 8
    for abandoned_after in range(0, 8):
        parts = Views(store).answer_in_parts(large)
        for _ in range(abandoned_after):
            next(parts)
        parts.close()
    parts = views.answer_in_parts(large.model_copy(update={"t": 0.5}))
    for _ in range(4):
        next(parts)
    parts.close()
    assert Views(store).answer(large).body == whole.body


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("attempt", [None, 1])
def test_pictures_are_coarse_while_time_is_short_and_exact_formats_are_not(
    store: Store, attempt: int | None, level: int
) -> None:
    snapshots = Snapshots(period_s=1e9)
    views, shown = Views(store, snapshots), new_job_id()
    if attempt is None:
        snapshots.begin(shown)
        snapshots.offer(scene(), 40)
    else:
        publish(store, shown)
    request = RenderRequest(scene_id=shown, attempt=attempt, t=0, format=ImageFormat.JPEG)
    coarse, exact = (views.answer(each, level) for each in (request, request_of(shown, attempt=attempt)))
    assert NoticeCode.COARSE in [each.code for each in coarse.warnings]
    assert NoticeCode.COARSE not in [each.code for each in exact.warnings]
    again = views.answer(request, level)
    assert (again.is_untimed, again.level, again.body) == (True, level, coarse.body)
    assert views.cost(request) > 0  # it is rendered again when there is time
    sharp = views.answer(request)
    assert views.cost(request) == 0
    assert NoticeCode.COARSE not in [each.code for each in sharp.warnings]
    pictures = [cv2.imdecode(np.frombuffer(each.body, np.uint8), cv2.IMREAD_COLOR) for each in (coarse, sharp)]
    assert pictures[0].shape == pictures[1].shape == (CLIP.height, CLIP.width, 3)
    assert np.abs(pictures[0].astype(float) - pictures[1]).mean() < 25  # few Gaussians, anywhere and of any colour


def test_a_picture_of_a_scene_that_is_purged_while_it_is_rendered_is_not_kept(store: Store, scene_id: str) -> None:
    views, large = Views(store), large_of(request_of(scene_id))

    def purge(number: int) -> None:
        store.purge(scene_id)
        views.forget_purged()

    made_with(views.answer_in_parts(large), purge)
    assert views.cached == ()
    assert views.cost(large) > 0


@pytest.mark.parametrize("lens", [{"fx": 1e-5}, {"fx": 5e-324}, {"fy": 1e-200}, {"fx": 1e5, "fy": 1e-200}])
def test_a_lens_that_sees_more_than_any_does_is_answered_in_pixels_that_are_not_too_many(
    lens: dict[str, float], store: Store, scene_id: str
) -> None:
    views = Views(store)
    views.answer(request_of(scene_id))
    wide = request_of(scene_id).model_copy(update={"camera": IntrinsicsOverride(width=16, height=12, **lens)})
    assert views.cost(wide) <= render_cost(1 << 21, len(scene().gaussians))
    assert np.load(io.BytesIO(views.answer(wide).body)).shape[:2] == (12, 16)


@pytest.mark.parametrize("layer", [Layer.RGB, Layer.CONFIDENCE])
@pytest.mark.parametrize("pose", [None, "orbit:10,0,1"])
@pytest.mark.parametrize(
    ("lens", "max_pixels"),
    [
        ({"width": 16, "height": 12}, 2_000),
        ({"width": 16, "height": 12}, 4_000),
        ({"width": 64, "height": 48}, 4_000),
        ({"width": 128}, 13_000),
        ({"width": 60, "height": 40, "fx": 200.0}, 2_500),
        ({"width": 16, "height": 12, "fx": 0.1, "fy": 0.1}, 4_000),
        ({"width": 16, "height": 12, "fx": 1e-5}, 4_000),
    ],
)
def test_no_picture_is_drawn_of_more_pixels_than_the_limit_and_a_view_costs_all_that_are_drawn_for_it(
    lens: dict[str, Any],
    max_pixels: int,
    pose: str | None,
    layer: Layer,
    store: Store,
    scene_id: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn, project = list[int](), Rasterizer.project

    def noted(rasterizer: Rasterizer, *args: Any) -> None:
        drawn.append(rasterizer.width * rasterizer.height)
        project(rasterizer, *args)

    monkeypatch.setattr(Rasterizer, "project", noted)
    views = Views(store)
    asked = {"camera": IntrinsicsOverride(**lens), "max_pixels": max_pixels, "layer": layer}
    view = request_of(scene_id, t=0.5).model_copy(update={**asked, "pose": pose and parse_pose(pose)})
    assert views.cost(view) == sum(render_cost(each, TYPICAL_GAUSSIANS) for each in view.most_drawn(TYPICAL_SIZE))
    views.answer(view.model_copy(update={"t": 0.25}))
    cost, gaussians = views.cost(view), len(scene().gaussians)
    drawn.clear()
    views.answer(view)
    assert max(drawn) <= max_pixels
    assert cost == sum(render_cost(each, gaussians) for each in drawn)
    at_most = sum(render_cost(each, 1) for each in view.most_drawn((CLIP.width, CLIP.height)))
    assert cost / gaussians <= at_most


def test_a_small_picture_through_a_wide_lens_counts_what_is_drawn_for_it_towards_the_limits(scene_id: str) -> None:
    small = request_of(scene_id).model_copy(update={"camera": IntrinsicsOverride(width=16, height=12)})
    wide = small.model_copy(update={"camera": IntrinsicsOverride(width=16, height=12, fx=0.01)})
    assert small.most_drawn((640, 512)) == [640 * 512]
    assert wide.most_drawn((640, 512)) == [1 << 21]
    assert wide.model_copy(update={"max_pixels": 50_000}).most_drawn((640, 512)) == [50_000]


def test_others_are_answered_while_a_large_picture_is_encoded(
    store: Store, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, answered, encode = threading.Event(), threading.Event(), rendered_module.encode_layer

    def slow(*args: Any, **named: Any) -> bytes:
        begun.set()
        assert answered.wait(60), "nobody was answered meanwhile"
        return encode(*args, **named)

    monkeypatch.setattr(rendered_module, "encode_layer", slow)

    def look(number: int) -> None:
        if begun.is_set():
            answered.set()

    large = large_of(request_of(scene_id), format=ImageFormat.JPEG)
    assert made_with(Views(store).answer_in_parts(large), look).body
    assert answered.is_set()
