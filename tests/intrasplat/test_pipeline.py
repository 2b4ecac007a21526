"""A clip on disk becomes a scene: every preset, every length of clip, stereo and depth; or an error that names why."""
# long: the pipeline is one story, and its clips and scenes are made once for all of it

from __future__ import annotations

import csv
import dataclasses
import gc
import hashlib
import json
import shutil
import weakref
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

from intrasplat.clip import DepthClip, open_clip, split_frames
from intrasplat.errors import Cancelled, InputError, SceneError, TrainingDiverged, UnavailableError
from intrasplat.machine.hooks import Progress
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import PRESETS
from intrasplat.names import DETAIL, LABORATORY_PRESETS, MANIFEST, RECORDED, REPORT, RESUME, RESUME_STATE
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions, parse_options
from intrasplat.outcome import scene_of
from intrasplat.picture import RecordedMasks
from intrasplat.pipeline import make, reconstruct, score_scene, score_stored_scene
from intrasplat.report import CameraPoses, Masks, Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.model import model_of
from intrasplat.scene.resume_file import RESUME_FILE
from intrasplat.splat.metrics import coverage, psnr_tissue
from intrasplat.splat.optimize import Rate
from intrasplat.splat.step import camera_vector
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.rate_distortion import TOLERANCE_DB, round_model
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.targets import camera_in_units
from intrasplat.view.recorded import stored_frame
from intrasplat.view.render import render_frame
from lab.phantom import PhantomSettings, make_phantom, write_endonerf, write_stereo_video
from tests.intrasplat.phantoms import FRAMES, HEIGHT, WIDTH, phantom_clip, prepared_on, trained, view

SCENE_FILES = {"manifest.json", "scene.safetensors", "report.json", "curve.csv", DETAIL, RECORDED}
ITERATIONS = 20
STEREO = PhantomSettings(width=128, height=112, frames=10, period_frames=12)
Drawn = Callable[..., Path]
Opened = Callable[..., DepthClip]
Whole = Callable[[str], tuple[Report, Path]]


@pytest.fixture(scope="module")
def endonerf(tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    """Draws a clip of so many frames (and width, height, settings of the phantom), once; it is read and not written."""

    @cache
    def drawn(frames: int, width: int = WIDTH, height: int = HEIGHT, **settings: Any) -> Path:
        folder = tmp_path_factory.mktemp("clip")
        made = make_phantom(PhantomSettings(width=width, height=height, frames=frames, period_frames=12, **settings))
        write_endonerf(made, folder)
        return folder

    return drawn


@pytest.fixture(scope="module")
def clip(endonerf: Drawn) -> Path:
    return endonerf(FRAMES)


@pytest.fixture(scope="module")
def opened(endonerf: Drawn) -> Opened:
    """Reads a clip of so many frames, once, for tests of what comes after decoding; it is not written."""

    @cache
    def read(frames: int = FRAMES, width: int = WIDTH, height: int = HEIGHT) -> DepthClip:
        clip = open_clip(endonerf(frames, width, height))
        assert isinstance(clip, DepthClip)
        return clip

    return read


@pytest.fixture(scope="module")
def whole(clip: Path, opened: Opened, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Makes the clip's scene with a preset, once: its report and its folder, to be read."""

    @cache
    def made(preset: str) -> tuple[Report, Path]:
        out = tmp_path_factory.mktemp(preset)
        return run(clip if preset == "fast" else opened(), out, preset=preset), out

    return made


@pytest.fixture(scope="module")
def stopped(opened: Opened, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was stopped after two steps: copy it before you go on in it."""
    out = tmp_path_factory.mktemp("stopped")
    with pytest.raises(Cancelled):
        run(opened(), out, stopping_after(2))
    return out


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a stereo video, its calibration and masks."""
    folder = tmp_path_factory.mktemp("stereo")
    write_stereo_video(make_phantom(STEREO), folder)
    return folder


def run(clip: Path | DepthClip, out: Path, hooks: TrainingHooks | None = None, **options: Any) -> Report:
    """Reconstruct with options and fields of the request by their names; `preset` may be a preset of one's own."""
    return reconstruct(request(clip, **options), out, hooks or TrainingHooks())


def request(clip: Path | DepthClip, **options: Any) -> ReconstructionRequest:
    options = {"iterations": ITERATIONS, **options}
    if options.get("preset") in LABORATORY_PRESETS:
        options["preset"] = PRESETS[options["preset"]]
    if isinstance(options.get("preset"), Preset):
        options["own_preset"] = options.pop("preset")
    fields = {field.name for field in dataclasses.fields(ReconstructionRequest)}
    of_request = {name: options.pop(name) for name in fields & options.keys()}
    asked = parse_options(ReconstructionOptions, options)
    return ReconstructionRequest(clip, asked, **of_request)


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def tensor_bits(folder: Path) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in load_scene(folder).tensors().items()}


def stopping_after(iterations: int) -> TrainingHooks:
    """TrainingHooks that let a run come this far in its training."""
    stages: set[str] = set()
    asked = 0

    def should_stop() -> bool:
        nonlocal asked
        asked += "train" in stages
        return asked > iterations

    return TrainingHooks(lambda progress: stages.add(progress.stage), should_stop)


@pytest.mark.parametrize("name", [*PRESETS, *LABORATORY_PRESETS])
def test_every_preset_makes_a_scene_that_renders(name: str, whole: Whole) -> None:
    report, out = whole(name)
    assert files(out) == SCENE_FILES
    scene = load_scene(out)
    assert (scene.preset, report.preset) == (name, name)
    assert report.gaussians == len(scene.gaussians)
    assert report.iterations == ITERATIONS
    assert report.psnr_tissue_db is not None
    frame = render_frame(scene, 0.4)
    assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
    assert frame.rgb.std() > 10


def test_the_report_tells_what_was_done(clip: Path, tmp_path: Path) -> None:
    told: list[Progress] = []
    report = run(clip, tmp_path, TrainingHooks(on_progress=told.append), seed=5)
    assert Report.model_validate_json((tmp_path / "report.json").read_text()) == report
    assert (report.seed, report.held_out, report.train_count) == (5, (1, 9), FRAMES - 2)
    stages = {"decode_s", "compile_s", "fusion_s", "motion_s", "start_s", "targets_s", "optimise_s", "score_s"}
    assert stages | {"t_train_s", "t_post_s"} <= report.seconds.keys()
    assert 0 < report.seconds["t_train_s"] <= report.seconds["t_post_s"]
    assert report.depth_agreement_mm is not None
    assert report.depth_agreement_mm < 3
    assert report.assumptions
    assert NoticeCode.FEW_FRAMES in [each.code for each in report.warnings]
    with (tmp_path / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["iteration"]) == report.frames_seen == ITERATIONS
    assert float(rows[-1]["psnr_tissue_db"]) == pytest.approx(report.psnr_tissue_db, abs=1e-3)
    assert [stage for i, stage in enumerate(each.stage for each in told) if i == 0 or told[i - 1].stage != stage] == [
        "decode",
        "compile",
        "motion",
        "fusion",
        "start",
        "train",
        "finish",
        "score",
    ]


def test_the_same_request_gives_the_same_scene(opened: Opened, whole: Whole, tmp_path: Path) -> None:
    first, out = whole("fast")
    again = run(opened(), tmp_path)
    assert tensor_bits(tmp_path) == tensor_bits(out)
    assert again.frames == first.frames


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_a_stopped_run_goes_on_in_its_folder(
    name: str, clip: Path, opened: Opened, whole: Whole, tmp_path: Path
) -> None:
    straight, out = whole(name)
    given = clip if name == "fast" else opened()
    with pytest.raises(Cancelled):
        run(given, tmp_path / "stopped", stopping_after(7), preset=name)
    assert (
        RESUME in files(tmp_path / "stopped") <= set(RESUME_STATE)
    )  # the clip may still have been on its way to the disk
    resumed = run(given, tmp_path / "stopped", preset=name)
    assert files(tmp_path / "stopped") == SCENE_FILES
    assert tensor_bits(tmp_path / "stopped") == tensor_bits(out)
    assert (resumed.frames, resumed.iterations) == (straight.frames, straight.iterations)


def test_a_run_stopped_while_its_scene_is_finished_trains_no_more(opened: Opened, whole: Whole, tmp_path: Path) -> None:
    _, out = whole("fast")
    stages: list[str] = []
    hooks = TrainingHooks(lambda progress: stages.append(progress.stage), lambda: stages.count("finish") > 2)
    with pytest.raises(Cancelled, match="finished"):
        run(opened(), tmp_path / "stopped", hooks, preset="fast")
    stages.clear()
    run(opened(), tmp_path / "stopped", TrainingHooks(lambda progress: stages.append(progress.stage)), preset="fast")
    assert "motion" not in stages
    assert tensor_bits(tmp_path / "stopped") == tensor_bits(out)


def test_a_run_stopped_while_it_is_scored_leaves_its_scene(opened: Opened, whole: Whole, tmp_path: Path) -> None:
    _, out = whole("fast")
    stages: set[str] = set()
    hooks = TrainingHooks(lambda progress: stages.add(progress.stage), lambda: "score" in stages)
    with pytest.raises(Cancelled, match="scoring"):
        run(opened(), tmp_path / "stopped", hooks, preset="fast")
    assert files(tmp_path / "stopped") == SCENE_FILES
    assert tensor_bits(tmp_path / "stopped") == tensor_bits(out)
    report = Report.model_validate_json((tmp_path / "stopped" / "report.json").read_text())
    assert report.psnr_tissue_db is None
    assert NoticeCode.SCORES_FAILED in [each.code for each in report.warnings]


def test_a_scene_is_whole_before_it_is_scored_and_is_scored_alike_from_disk(
    clip: Path, whole: Whole, tmp_path: Path
) -> None:
    straight, out = whole("fast")
    asked = request(clip, preset="fast")
    made = make(asked, tmp_path, TrainingHooks())
    assert files(tmp_path) == SCENE_FILES
    assert tensor_bits(tmp_path) == tensor_bits(out)
    assert not made.report.scored
    again = score_stored_scene(asked, tmp_path, TrainingHooks())
    assert again.frames == score_scene(made, TrainingHooks()).frames == straight.frames
    assert again.warnings == straight.warnings


def test_a_scene_of_a_moving_camera_is_scored_anew_from_its_own_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = PhantomSettings(width=96, height=80, frames=10, camera=("swing",))
    write_endonerf(make_phantom(moving), tmp_path / "clip")
    asked = request(tmp_path / "clip", preset="fast")
    made = make(asked, tmp_path / "out", TrainingHooks())
    assert (made.scene.world_from_camera != made.scene.world_from_camera[0]).any()
    again = score_stored_scene(asked, tmp_path / "out", TrainingHooks())
    assert again.frames == score_scene(made, TrainingHooks()).frames
    lost = CameraPoses(source="estimated", unsure_frames=(2,))
    unsure = made.report.model_copy(update={"poses": lost})
    (tmp_path / "out" / "report.json").write_text(unsure.model_dump_json())
    split = Mock(wraps=split_frames)
    monkeypatch.setattr("intrasplat.pipeline.split_frames", split)
    score_stored_scene(asked, tmp_path / "out", TrainingHooks())
    assert split.call_args.args[0].skipped == (2,)


def test_a_stopped_run_with_a_budget_keeps_its_schedule(opened: Opened, tmp_path: Path) -> None:
    with pytest.raises(Cancelled) as stopped:
        run(opened(), tmp_path, stopping_after(3), iterations=None, budget_s=1.0)
    planned = int(str(stopped.value).rstrip(".").rsplit(" ", 1)[1])
    assert run(opened(), tmp_path, iterations=None, budget_s=1.0).iterations == planned


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_a_budget_too_short_for_its_frames_is_told(name: str, opened: Opened, tmp_path: Path) -> None:
    def told(**length: Any) -> bool:
        report = run(opened(), tmp_path / str(length), preset=name, **length)
        return NoticeCode.TIME_TOO_SHORT in [each.code for each in report.warnings]

    assert told(iterations=None, budget_s=1e-6)
    assert not told(iterations=FRAMES - 2)
    assert not told(iterations=3)


@pytest.mark.parametrize(
    "change", [{"preset": "paper"}, {"seed": 1}, {"iterations": ITERATIONS + 1}, {"holdout": "2"}, {"clip": "another"}]
)
def test_a_stopped_run_does_not_go_on_as_something_else(
    change: dict[str, Any], opened: Opened, stopped: Path, tmp_path: Path
) -> None:
    shutil.copytree(stopped, tmp_path / "out")
    stored = (tmp_path / "out" / RESUME_FILE).read_bytes()
    if "clip" in change:
        change = {"clip": dataclasses.replace(opened(), rgb=255 - opened().rgb)}
    with pytest.raises(InputError, match="was started with another") as refused:
        run(**{"clip": opened(), "out": tmp_path / "out", **change})
    assert refused.value.field == "--out"
    assert (tmp_path / "out" / RESUME_FILE).read_bytes() == stored


def test_a_damaged_stopped_run_is_refused(clip: Path, tmp_path: Path) -> None:
    (tmp_path / RESUME_FILE).write_bytes(b"half a file")
    with pytest.raises(InputError, match="new folder"):
        run(clip, tmp_path)


def test_training_that_diverges_publishes_nothing(opened: Opened, tmp_path: Path) -> None:
    fast = PRESETS["fast"]
    wild = dataclasses.replace(fast, rates=dataclasses.replace(fast.rates, mean=Rate(1e30)))
    with np.errstate(all="ignore"), pytest.raises(TrainingDiverged):
        run(opened(), tmp_path, preset=wild)
    assert files(tmp_path) == set()


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"iterations": 0}, "options.iterations"),
        ({"iterations": -4}, "options.iterations"),
        ({"iterations": None, "budget_s": 0.0}, "options.budget_s"),
        ({"iterations": None, "budget_s": float("nan")}, "options.budget_s"),
        ({"iterations": 5, "budget_s": 5.0}, "options.budget_s"),
        ({"seed": -1}, "options.seed"),
        ({"preset": "best"}, "options.preset"),
        ({"holdout": "99"}, "options.holdout"),
        ({"pose_convention": "blender"}, "options.pose_convention"),
    ],
)
def test_options_that_cannot_be_meant_are_refused(
    options: dict[str, Any], field: str, clip: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as refused:
        run(clip, tmp_path, **options)
    assert refused.value.field == field
    assert files(tmp_path) == set()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="cuda"):
        run(tmp_path / "nothing", tmp_path / "out", device="cuda")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["fast", "paper", "hexplane"])
@pytest.mark.parametrize("frames", [1, 2, 4, 8])
def test_a_short_clip_trains_without_a_measured_quality(
    frames: int, name: str, endonerf: Drawn, opened: Opened, tmp_path: Path
) -> None:
    clip = endonerf(frames) if (name, frames) == ("fast", 1) else opened(frames)
    report = run(clip, tmp_path / "out", preset=name, iterations=3)
    assert (report.held_out, report.train_count) == ((), frames)
    assert report.psnr_tissue_db is None
    assert report.depth_agreement_mm is None
    assert any("held out" in warning.text for warning in report.warnings)
    assert "t_train_s" in report.seconds
    assert render_frame(load_scene(tmp_path / "out"), 0.9).rgb.any()


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_odd_sizes_are_no_trouble(name: str, endonerf: Drawn, opened: Opened, tmp_path: Path) -> None:
    clip = endonerf(9, 97, 81) if name == "fast" else opened(9, 97, 81)
    report = run(clip, tmp_path / "out", preset=name)
    assert (report.width, report.height) == (97, 81)
    assert report.train_psnr_tissue_db is not None
    assert render_frame(load_scene(tmp_path / "out"), 0.0).rgb.shape == (81, 97, 3)


def test_a_moving_camera_is_read_from_its_poses(endonerf: Drawn, tmp_path: Path) -> None:
    clip = endonerf(10, camera=("swing",))
    truth = make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=10, period_frames=12, camera=("swing",)))
    placed = {}
    for convention in ("opengl", "llff"):
        run(clip, tmp_path / convention, iterations=10, pose_convention=convention)
        placed[convention] = load_scene(tmp_path / convention).world_from_camera[7]
    np.testing.assert_allclose(placed["opengl"], truth.world_from_camera(7), atol=1e-6)
    assert np.abs(placed["llff"] - truth.world_from_camera(7)).max() > 0.1  # the wrong axes put it elsewhere


def test_tissue_whose_depth_is_never_known_is_covered_all_the_same() -> None:
    whole = phantom_clip(tools=False)
    depth_mm = whole.depth_mm.copy()
    depth_mm[:, 25:50, 30:60] = 0
    unsure = np.where(depth_mm > 0, whole.depth_confidence, np.uint8(0))
    holed = dataclasses.replace(whole, depth_mm=depth_mm, depth_confidence=unsure)
    split = split_frames(holed)
    made = trained(prepared_on(holed, split, "fast", iterations=60))
    scene_of(made)  # takes strays out of the model
    where = np.zeros_like(whole.tissue[0])
    where[25:50, 30:60] = True
    assert min(coverage(view(made, index).alpha, where) for index in range(FRAMES)) >= 0.98


def test_a_clip_without_any_depth_is_refused(clip: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(clip, tmp_path / "clip")
    for path in (broken / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="depth"):
        run(broken, tmp_path / "out")
    assert files(tmp_path / "out") == set()


def test_a_stereo_clip_without_calibration_is_refused(stereo: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        run(stereo / "stereo.webm", tmp_path, masks=stereo / "masks.zip")
    assert refused.value.field == "calibration"
    assert f"{STEREO.width} x {STEREO.height}" in refused.value.problem


def test_a_stereo_video_becomes_a_scene_of_the_right_size_in_mm(stereo: Path, tmp_path: Path) -> None:
    beside: dict[str, Any] = {"calibration": stereo / "calibration.json", "masks": stereo / "masks.zip"}
    report = run(stereo / "stereo.webm", tmp_path, **beside, iterations=60)
    assert report.psnr_tissue_db is not None
    assert report.psnr_tissue_db > 20
    assert report.depth_agreement_mm is not None
    assert report.depth_agreement_mm < 2
    truth = make_phantom(STEREO).frame(5)
    frame = render_frame(load_scene(tmp_path), 0.5)
    both = truth.tissue & (frame.depth_mm > 0)
    assert np.median(np.abs(frame.depth_mm - truth.depth_mm)[both]) < 2


def test_a_stopped_run_on_a_stereo_clip_goes_on_with_the_same_depth(stereo: Path, tmp_path: Path) -> None:
    beside: dict[str, Any] = {"calibration": stereo / "calibration.json", "masks": stereo / "masks.zip"}
    stages: set[str] = set()
    in_training = TrainingHooks(lambda progress: stages.add(progress.stage), lambda: "train" in stages)
    with pytest.raises(Cancelled):
        run(stereo / "stereo.webm", tmp_path / "stopped", in_training, **beside)
    run(stereo / "stereo.webm", tmp_path / "stopped", **beside)
    run(stereo / "stereo.webm", tmp_path / "whole", **beside)
    assert tensor_bits(tmp_path / "stopped") == tensor_bits(tmp_path / "whole")


def test_the_pipeline_and_the_loop_make_the_same_model(clip: Path, whole: Whole) -> None:
    opened = open_clip(clip)
    assert isinstance(opened, DepthClip)
    split = split_frames(opened)
    loop = trained(prepared_on(opened, split, "fast", iterations=ITERATIONS))
    scene = scene_of(loop)
    rounded = round_model(model_of(scene), scene, loop.eyes)
    assert rounded is not None
    small = rounded.stored(scene).scene
    assert tensor_bits(whole("fast")[1]) == {name: each.numpy().tobytes() for name, each in small.tensors().items()}


def test_what_is_stored_is_what_was_scored_and_the_report_tells_its_price(clip: Path, whole: Whole) -> None:
    report, out = whole("fast")
    opened, scene = open_clip(clip), load_scene(out)
    assert isinstance(opened, DepthClip)
    model = model_of(scene)
    for score in report.frames:
        pose = scene.world_from_camera[score.frame]
        camera = camera_vector(camera_in_units(scene.intrinsics, pose, scene.units_per_mm))
        image = model.render(camera, float(opened.t[score.frame]))[:3].transpose(1, 2, 0)
        expected = psnr_tissue(image, opened.rgb[score.frame], opened.tissue[score.frame])
        assert score.psnr_tissue_db == pytest.approx(expected, abs=1e-6)
    assert report.scene_bytes == (out / "scene.safetensors").stat().st_size
    assert report.scene_bytes < 0.25 * scene.byte_count
    assert 0 <= report.measurements["stored_loss_db"] <= TOLERANCE_DB
    assert any("All scores are of the stored scene" in each.text for each in report.assumptions)
    assert report.seconds["shrink_s"] > 0


def test_found_masks_are_kept_with_the_scene_as_a_file_to_correct(tmp_path: Path) -> None:
    drawn = make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=3, period_frames=12)).depth_clip()
    found = dataclasses.replace(drawn, masks=Masks(source="found", share=0.1, sure=0.9))
    shown: list[DepthClip] = []
    for clip, files in ((found, {*SCENE_FILES, "masks.zip"}), (drawn, SCENE_FILES)):
        out = tmp_path / str(len(files))
        reconstruct(request(clip, iterations=2, holdout="none"), out, TrainingHooks(on_clip=shown.append))  # type: ignore[arg-type]
        assert {path.name for path in out.iterdir()} == files
    assert [clip.masks for clip in shown] == [found.masks, drawn.masks]


@pytest.mark.parametrize(("eyes", "kept"), [("both", ("left", "right")), ("left", ("left",))])
def test_recorded_frames_of_the_eyes_that_taught_are_kept_with_the_scene(
    stereo: Path, tmp_path: Path, eyes: str, kept: tuple[str, ...]
) -> None:
    shown: list[DepthClip] = []
    files_of_clip = {"calibration": stereo / "calibration.json", "masks": stereo / "masks.zip"}
    given = request(stereo / "stereo.webm", iterations=2, eyes=eyes, **files_of_clip)
    report = reconstruct(given, tmp_path, TrainingHooks(on_clip=shown.append))
    told = report.recorded
    assert told is not None
    assert (told.eyes, told.frames, told.masks) == (kept, tuple(range(STEREO.frames)), True)
    assert told.size_bytes == sum((tmp_path / name).stat().st_size for name in (DETAIL, RECORDED))
    assert Report.model_validate_json((tmp_path / REPORT).read_bytes()).recorded == told
    listed = json.loads((tmp_path / MANIFEST).read_bytes())["beside"][RECORDED]
    assert listed == {
        "bytes": (tmp_path / RECORDED).stat().st_size,
        "sha256": hashlib.sha256((tmp_path / RECORDED).read_bytes()).hexdigest(),
    }
    for eye, name in zip(shown[0].eyes, told.eyes, strict=False):
        for index in (0, 5, 9):
            off = RecordedMasks.OFF, RecordedMasks.ONLY
            (_, jpeg), (_, png) = (stored_frame(tmp_path, 10, index / 10, name, each) for each in off)
            rgb = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
            assert cv2.PSNR(np.ascontiguousarray(rgb), eye.rgb[index]) > 30
            mask = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
            np.testing.assert_array_equal(mask > 0, ~eye.tissue[index])


def test_nothing_of_the_recording_is_kept_where_that_is_off(opened: Opened, tmp_path: Path) -> None:
    report = run(opened(), tmp_path, iterations=2, keep_recorded="off")
    assert report.recorded is None
    assert files(tmp_path) == SCENE_FILES - {DETAIL, RECORDED}
    assert json.loads((tmp_path / MANIFEST).read_bytes())["beside"] == {}
    with pytest.raises(InputError, match="keep_recorded"):
        request(opened(), keep_recorded="perhaps")


def test_a_clip_goes_with_its_job_and_does_not_wait_for_the_garbage_collector(clip: Path, tmp_path: Path) -> None:
    clips: list[weakref.ref[DepthClip]] = []
    hooks = TrainingHooks(on_clip=lambda whole: clips.append(weakref.ref(whole)))
    gc.disable()
    try:
        run(clip, tmp_path, hooks, iterations=2)
        assert [each() for each in clips] == [None]
    finally:
        gc.enable()


def test_a_run_that_ends_between_its_recorded_frames_and_its_scene_can_be_made_again(
    opened: Opened, tmp_path: Path
) -> None:
    run(opened(), tmp_path / "whole", iterations=2)
    cut = tmp_path / "cut"
    shutil.copytree(tmp_path / "whole", cut)
    (cut / MANIFEST).unlink()  # it is written last, so a scene without it is none
    (cut / RECORDED).write_bytes(b"PK")
    with pytest.raises(SceneError):
        load_scene(cut)
    run(opened(), cut, iterations=2)
    assert (cut / RECORDED).read_bytes() == (tmp_path / "whole" / RECORDED).read_bytes()
    assert tensor_bits(cut) == tensor_bits(tmp_path / "whole")
