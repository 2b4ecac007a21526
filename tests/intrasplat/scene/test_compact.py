"""A compact scene: its error, its size, and that no hostile file does harm."""

from __future__ import annotations

import dataclasses
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from intrasplat.clip import DepthClip, spread
from intrasplat.errors import SceneError
from intrasplat.outcome import scene_of
from intrasplat.scene import checkpoint, compact
from intrasplat.scene.checkpoint import MANIFEST_FILE, SCENE_FILE, load_scene, save_scene
from intrasplat.scene.compact import MIN_POWER, state_rows, unpack
from intrasplat.scene.differences import MAX_STORED
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR_CHANNELS, VALUES
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.rate_distortion import SCORED_FRAMES, TOLERANCE_DB, QuantizedScene, round_model
from intrasplat.train.targets import TrainingFrames
from tests.intrasplat.phantoms import phantom_clip, prepared, trained
from tests.intrasplat.scene.compacting import TIMES, compacted, effect_of, rounded, shared
from tests.intrasplat.scene.plain_reader import read_plainly
from tests.intrasplat.scenes import random_scene


def states(scene: TrainedScene, t: float) -> Tensor:
    """[N, 14] at time t, unit quaternions, in an order that does not depend on the file's."""
    moved = scene.deformation.deform(scene.gaussians, t)
    unit = torch.nn.functional.normalize(moved.quaternion, dim=-1)
    columns = [moved.mean, unit, moved.log_scale, moved.sh[:, 0], moved.opacity_logit[:, None], scene.seen[:, None]]
    table = torch.cat(columns, 1)
    return table[torch.argsort(moved.opacity_logit)]


def colourful(count: int) -> TrainedScene:
    """A scene whose colour moves, too."""
    scene = told_apart(random_scene(count=count))
    still = shared(scene)
    weight = 0.1 * torch.randn(count, 13, 5, generator=torch.Generator().manual_seed(1))
    return dataclasses.replace(scene, deformation=SharedBasis(weight, still.centre, still.width))


def at_rest(gaussians: Gaussians) -> list[Tensor]:
    """The numbers of a Gaussian at rest, in the file's order."""
    one = gaussians
    return [one.mean, one.quaternion, one.log_scale, one.sh[:, 0], one.opacity_logit[:, None]]


def told_apart(scene: TrainedScene) -> TrainedScene:
    """The scene with opacities by which a Gaussian is known again in another order."""
    gaussians = dataclasses.replace(scene.gaussians, opacity_logit=torch.linspace(-2, 2, len(scene.gaussians)))
    return dataclasses.replace(scene, gaussians=gaussians)


@pytest.mark.parametrize(
    "scene", [told_apart(random_scene(count=300)), colourful(300)], ids=["ten channels", "thirteen"]
)
def test_at_the_trained_times_the_scene_is_off_by_about_a_step(scene: TrainedScene) -> None:
    step, small = 1e-3, compacted(scene)
    for t in TIMES:
        error = (states(small, float(t)) - states(scene, float(t))).abs()
        assert error[:, :-1].max() < 8 * step  # rotations of short quaternions are off by more
        assert error[:, :-1].mean() < step
        assert error[:, -1].max() <= 0.5 / 63 + 1e-6


def test_what_was_seen_at_all_stays_seen_and_nothing_else_becomes_so() -> None:
    scene = told_apart(random_scene(count=64))
    scene.seen[:3] = torch.tensor([0.0, 1e-4, 0.004])
    assert int((compacted(scene).seen > 0).sum()) == 63


def test_a_finer_step_means_a_smaller_error() -> None:
    scene = colourful(200)
    errors = [
        float((states(compacted(scene, step), 0.5) - states(scene, 0.5))[:, :-1].abs().mean()) for step in (1e-2, 1e-3)
    ]
    assert errors[1] < 0.15 * errors[0]


def test_a_channel_that_matters_more_is_kept_better() -> None:
    scene, effect = colourful(300), effect_of(300)
    effect[0] *= 100.0
    gaussians, deformation, _ = rounded(scene, 1e-2, effect).model()
    small = dataclasses.replace(scene, gaussians=gaussians, deformation=deformation)
    error = torch.stack([(states(small, t) - states(scene, t)).abs().mean(0) for t in TIMES]).mean(0)
    assert error[1] > 2e-3
    assert error[0] < 0.15 * error[1]


@pytest.mark.parametrize("step", [1e-3, 0.1, 0.5, 1.0, 100.0])
def test_no_rotation_is_rounded_to_nothing(step: float) -> None:
    scene, effect = colourful(400), effect_of(400)
    effect[:, :200] = 1e-6
    scene.gaussians.quaternion[::2] = torch.tensor([0.5, -0.5, 0.5, 0.5])
    scene.gaussians.quaternion[7] = 0
    shared(scene).weight.zero_()
    small = rounded(scene, step, effect)
    assert small.table[:, 3:7].any(axis=1).all()
    assert torch.linalg.norm(small.model()[0].quaternion, dim=1).min() > 0.4


def test_a_gaussian_that_matters_more_is_kept_better_but_none_is_given_up() -> None:
    effect = effect_of(400)
    effect[:, :200] = 1e-6
    power = rounded(random_scene(count=400), 1e-3, effect).table[:, -4:-1]
    assert sorted(power[:, 0])[:200] == [MIN_POWER] * 200
    assert power[:, 0].max() >= 0


@pytest.mark.parametrize("count", [1, 2, 3, 10, 257])
def test_what_is_stored_is_what_is_read(count: int) -> None:
    small = rounded(colourful(count))
    back = unpack(small.tensors())
    np.testing.assert_array_equal(back.table, small.table)
    for before, after in zip(small.model()[0].tensors().values(), back.model()[0].tensors().values(), strict=True):
        assert torch.equal(before, after)
    assert torch.equal(small.model()[1].weight, back.model()[1].weight)


def test_a_scene_comes_back_from_its_folder_as_it_was_scored(tmp_path: Path) -> None:
    scene = compacted(colourful(120))
    save_scene(tmp_path, scene)
    back = load_scene(tmp_path)
    assert all(torch.equal(before, back.tensors()[name]) for name, before in scene.tensors().items())
    assert (tmp_path / SCENE_FILE).stat().st_size == scene.file_bytes == back.file_bytes
    assert json.loads((tmp_path / MANIFEST_FILE).read_text())["coding"] == "compact"
    save_scene(tmp_path / "again", back)
    assert (tmp_path / "again" / SCENE_FILE).read_bytes() == (tmp_path / SCENE_FILE).read_bytes()


@pytest.mark.parametrize(
    "scene", [told_apart(random_scene(count=90)), colourful(200)], ids=["ten channels", "thirteen"]
)
def test_a_reader_written_from_the_page_alone_reads_the_same(tmp_path: Path, scene: TrainedScene) -> None:
    effect = effect_of(len(scene.gaussians)) * np.geomspace(0.01, 100, len(scene.gaussians))
    small = rounded(scene, 1e-2, effect)
    gaussians, deformation, seen = small.model()
    stored = small.tensors()
    assert 0 < stored["shared"].sum() < len(stored["shared"])
    save_scene(
        tmp_path, dataclasses.replace(scene, gaussians=gaussians, deformation=deformation, seen=seen, stored=stored)
    )
    plain = read_plainly(tmp_path)
    state = torch.cat([each.flatten(1) for each in at_rest(gaussians)], 1)
    torch.testing.assert_close(torch.tensor(plain.state), state, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(torch.tensor(plain.weight), deformation.weight, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(torch.tensor(plain.seen), seen)


def test_the_same_scene_gives_the_same_bytes() -> None:
    first, second = (save(rounded(colourful(200)).tensors()) for _ in range(2))
    assert first == second


def test_rest_costs_next_to_nothing() -> None:
    moving = colourful(2000)
    still = shared(moving)
    resting = dataclasses.replace(moving, deformation=dataclasses.replace(still, weight=torch.zeros_like(still.weight)))
    bytes_ = [len(save(rounded(each, 1e-2).tensors())) for each in (resting, moving)]
    motionless = len(
        save(rounded(dataclasses.replace(moving, deformation=SharedBasis.initial(2000, bases=1)), 1e-2).tensors())
    )
    assert bytes_[0] < motionless + 2000
    assert bytes_[1] > 2 * bytes_[0]


def test_neighbours_that_move_alike_share_the_cost() -> None:
    count, random = 3000, np.random.default_rng(0)
    place = torch.from_numpy(random.uniform(-20, 20, (count, 2))).float()
    scene = random_scene(count=count)
    mean = torch.cat([place, torch.full((count, 1), 60.0)], 1)
    gaussians = dataclasses.replace(scene.gaussians, mean=mean)
    weight = torch.zeros(count, 10, 5)
    weight[:, 0] = torch.sin(place[:, :1] / 6 + torch.arange(5))
    alike = SharedBasis(weight, shared(scene).centre, shared(scene).width)
    apart = dataclasses.replace(alike, weight=weight[torch.from_numpy(random.permutation(count))])
    sizes = [
        len(save(rounded(dataclasses.replace(scene, gaussians=gaussians, deformation=each), 1e-2).tensors()))
        for each in (alike, apart)
    ]
    assert sizes[0] < sizes[1] - 2000


def _change(name: str, value: Tensor | None) -> dict[str, Tensor]:
    stored = rounded(colourful(50)).tensors()
    if value is None:
        del stored[name]
        return stored
    return stored | {name: value}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("step", None, "step is missing"),
        ("code.2", None, r"code\.2 is missing"),
        ("code.0", torch.zeros(30, dtype=torch.uint8), "does not end"),
        ("count", torch.tensor([10**12]), "Gaussians of 70 numbers"),
        ("count", torch.tensor([0]), "Gaussians of 70 numbers"),
        ("count", torch.tensor([49]), "does not end|outside its range"),
        ("count", torch.tensor([1, 2]), "do not fit"),
        ("step", torch.ones(13), "do not fit"),
        ("step", torch.zeros(14), "a step or a quaternion is 0"),
        ("shared", torch.zeros(3, dtype=torch.uint8), "do not fit"),
        ("pattern", torch.zeros(13, 4, 6), "do not fit 6 bases"),
        ("pattern", torch.zeros(13, 4, 4), "do not fit 4 bases"),
        ("pattern", torch.zeros(13, 4, 5, dtype=torch.float64), "another type"),
    ],
)  # fmt: skip
def test_tensors_that_do_not_belong_together_are_refused(name: str, value: Tensor | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        unpack(_change(name, value))


def test_what_no_encoder_of_ours_writes_is_refused() -> None:
    small = rounded(colourful(50))
    small.table[7, 3:7] = 0
    with pytest.raises(ValueError, match="quaternion is 0"):
        unpack(small.tensors())
    small.table[7, 3] = 1
    small.table[3, 20] = MAX_STORED + 5
    with pytest.raises(ValueError, match="number exceeds"):
        unpack(small.tensors())


@pytest.mark.parametrize("bases", [1, 6])
def test_unpacking_takes_few_bytes_a_number(bases: int) -> None:
    scene = dataclasses.replace(random_scene(count=20_000), deformation=SharedBasis.initial(20_000, bases=bases))
    stored = rounded(scene, 0.1).tensors()
    tracemalloc.start()
    back = unpack(stored)
    back.model()
    peak = tracemalloc.get_traced_memory()[1] + 4 * VALUES * len(back.table)  # of numpy; and the Gaussians, of torch
    tracemalloc.stop()
    weights = len(back.table) * back.pattern.shape[0] * bases
    assert peak < 14 * back.table.size + 4 * weights + 2e6  # and the coder's models


def test_what_would_not_be_read_is_not_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact, "MAX_NUMBERS", 50 * 60)
    with pytest.raises(ValueError, match="at most 3000 numbers"):
        rounded(colourful(50))


def test_no_file_unpacks_to_more_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    stored = rounded(colourful(50)).tensors()
    monkeypatch.setattr(compact, "MAX_NUMBERS", 50 * 60)
    with pytest.raises(ValueError, match="at most 3000 numbers"):
        unpack(stored)


def test_a_hostile_file_is_refused_by_its_folder_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = compacted(colourful(60))
    assert scene.stored is not None
    for name, value in (
        ("code.1", torch.randint(0, 256, (500,), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))),
        ("width", torch.zeros(5)),
        ("step", torch.full((len(state_rows(COLOUR_CHANNELS)),), torch.inf)),
    ):
        hostile = dataclasses.replace(scene, stored=dict(scene.stored) | {name: value})
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "check_finite", lambda tensors: None)  # save_scene() refuses infinities
            save_scene(tmp_path, hostile)
        with pytest.raises(SceneError, match=tmp_path.name + "|step"):
            load_scene(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coding": "zip"}, "none of exact, half and compact"),
        ({"coding": "exact"}, "does not fit its manifest"),
        ({"deformation": "pfs"}, "not those the manifest speaks of"),
        ({"gaussians": 61}, "not those the manifest speaks of"),
    ],
)
def test_a_manifest_that_lies_of_a_compact_scene_is_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    save_scene(tmp_path, compacted(colourful(60)))
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest | change))
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path)


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_damage_to_a_compact_file_is_found(tmp_path: Path, damage: str) -> None:
    save_scene(tmp_path, compacted(colourful(60)))
    data = bytearray((tmp_path / SCENE_FILE).read_bytes())
    if damage == "cut":
        del data[-7:]
    else:
        data[-7] ^= 4
    (tmp_path / SCENE_FILE).write_bytes(data)
    with pytest.raises(SceneError, match=r"scene\.safetensors is damaged"):
        load_scene(tmp_path)


def quantized(scene: TrainedScene, frames: TrainingFrames, tolerance_db: float = TOLERANCE_DB) -> QuantizedScene | None:
    found = round_model(model_of(scene), scene, [frames], tolerance_db)
    return found and found.stored(scene)


def test_late_shrinking_takes_the_first_step_within_the_tolerance() -> None:
    run, _ = prepared(phantom_clip(), iterations=40)
    trained(run)
    scene, trials = scene_of(run), []
    found = round_model(model_of(scene), scene, [run.frames], 0.5, on_step=lambda: trials.append(1), limit_s=0.0)
    patient = round_model(model_of(scene), scene, [run.frames], 0.5)
    assert found is not None
    assert patient is not None
    assert found.loss_db <= 0.5
    assert found.step < patient.step
    assert len(trials) == 3  # before the sensitivity, before the trials, and one trial


def test_shrinking_keeps_its_tolerance_and_says_what_it_took() -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=40)
    trained(run)
    scene = scene_of(run)
    small, tiny = (quantized(scene, run.frames, tolerance_db) for tolerance_db in (0.1, 0.5))
    assert small is not None
    assert tiny is not None
    assert small.loss_db <= 0.1 < tiny.loss_db <= 0.5
    assert tiny.scene.file_bytes < small.scene.file_bytes < 0.25 * scene.byte_count
    assert f"{small.scene.file_bytes / 1e6:.2f} MB" in small.notices[0].text
    judged = spread(run.frames.indices, SCORED_FRAMES)
    assert small.frames == len(judged)
    exact, kept = (mean_db(each, clip, run.frames, judged) for each in (scene, small.scene))
    assert small.loss_db == pytest.approx(exact - kept, abs=1e-3)
    again = quantized(scene, run.frames, 0.1)
    assert again is not None
    assert again.step == small.step
    assert save(dict(again.scene.stored or {})) == save(dict(small.scene.stored or {}))


def mean_db(scene: TrainedScene, clip: DepthClip, frames: TrainingFrames, judged: list[int]) -> float:
    model = model_of(scene)
    images = [model.render(frames.cameras[i], float(frames.t[i]))[:3].transpose(1, 2, 0).copy() for i in judged]
    scores = [psnr_tissue(image, clip.rgb[i], clip.tissue[i]) for i, image in zip(judged, images, strict=True)]
    return float(np.mean(scores))


def frames_showing(clip: DepthClip, tissue: NDArray[np.bool_], like: TrainingFrames) -> TrainingFrames:
    return TrainingFrames(dataclasses.replace(clip, tissue=tissue), like.indices, like.scale)


def test_frames_without_tissue_are_not_judged_and_where_there_is_none_floats_are_kept() -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=10)
    trained(run)
    scene = scene_of(run)
    hidden = np.zeros_like(clip.tissue)
    assert quantized(scene, frames_showing(clip, hidden, run.frames)) is None
    first, second = run.frames.indices[:2]
    hidden[[first, second]] = clip.tissue[[first, second]]
    small = quantized(scene, frames_showing(clip, hidden, run.frames))
    assert small is not None
    assert small.frames == 2
    assert small.loss_db <= TOLERANCE_DB


def test_a_scene_that_whole_numbers_cannot_hold_stays_as_floats(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=10)
    scene = scene_of(run)
    scene.gaussians.mean[3, 0] = 1e9
    assert quantized(scene, run.frames) is None
    scene.gaussians.mean[3, 0] = 0
    monkeypatch.setattr(compact, "MAX_NUMBERS", 1000)
    assert quantized(scene, run.frames) is None


def test_models_that_are_not_known_are_left_as_floats() -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=1)
    for scene in (random_scene("fdm-gaussian"), random_scene("hexplane"), random_scene("shared", sh_degree=1)):
        assert quantized(scene, run.frames) is None
