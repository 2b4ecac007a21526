"""What is stored is loaded bit for bit, and what is damaged is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from contract.store.results import add_scores
from contract.wire.errors import SceneError
from contract.wire.report import Report
from tests.reports import REPORT_OF_A_SCENE
from tests.worker.scenes import KINDS, random_scene
from worker.scene.checkpoint import MANIFEST_FILE, SCENE_FILE, load_scene, save_scene
from worker.scene.resume_file import RESUME_FILE, RESUME_VERSION, begin_resume, load_resume


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_every_kind_of_scene_comes_back_bit_for_bit(tmp_path: Path, kind: str, sh_degree: int) -> None:
    scene = random_scene(kind, sh_degree=sh_degree)
    save_scene(tmp_path / "scene", scene)
    loaded = load_scene(tmp_path / "scene")
    assert loaded.deformation.kind == kind
    before, after = scene.tensors(), loaded.tensors()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    for t in (0.0, 0.37, 0.99):
        moved, expected = (each.deformation.deform(each.gaussians, t) for each in (loaded, scene))
        assert torch.equal(moved.mean, expected.mean)
        assert torch.equal(moved.log_scale, expected.log_scale)
    for name in ("intrinsics", "units_per_mm", "preset", "trained_t", "seed", "settings"):
        assert getattr(loaded, name) == getattr(scene, name)
    np.testing.assert_array_equal(loaded.world_from_camera, scene.world_from_camera)
    np.testing.assert_array_equal(loaded.frame_times_s, scene.frame_times_s)


def test_a_scene_that_is_being_trained_can_be_stored(tmp_path: Path) -> None:
    scene = random_scene("fdm-gaussian")
    for tensor in scene.deformation.parameters().values():
        tensor.requires_grad_()
    flat = torch.randn(2 * len(scene.gaussians), 3)
    gaussians = dataclasses.replace(scene.gaussians, mean=flat[::2].requires_grad_(), log_scale=flat[1::2])
    save_scene(tmp_path, dataclasses.replace(scene, gaussians=gaussians))
    loaded = load_scene(tmp_path)
    assert torch.equal(loaded.gaussians.mean, flat[::2])
    assert not loaded.gaussians.mean.requires_grad


def test_the_same_scene_gives_the_same_files(tmp_path: Path) -> None:
    for name in ("first", "second"):
        save_scene(tmp_path / name, random_scene())
    for file in (SCENE_FILE, MANIFEST_FILE):
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes()


def test_byte_count_is_the_size_on_disk_but_for_the_header(tmp_path: Path) -> None:
    scene = random_scene(count=500)
    save_scene(tmp_path, scene)
    assert 0 <= (tmp_path / SCENE_FILE).stat().st_size - scene.byte_count < 4096


def test_the_manifest_holds_the_hash_of_every_file_once_the_scores_are_known(tmp_path: Path) -> None:
    save_scene(tmp_path, random_scene())
    (tmp_path / "report.json").write_text(REPORT_OF_A_SCENE.model_copy(update={"scored": False}).model_dump_json())
    (tmp_path / "curve.csv").write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n2,31,\n")
    load_scene(tmp_path)
    add_scores(tmp_path, REPORT_OF_A_SCENE)
    assert Report.model_validate_json((tmp_path / "report.json").read_bytes()) == REPORT_OF_A_SCENE
    assert (tmp_path / "curve.csv").read_text().splitlines()[1:] == ["1,30,", "2,36.2000,"]
    load_scene(tmp_path)
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    assert set(manifest["files"]) == {SCENE_FILE, "report.json", "curve.csv"}
    for name, entry in manifest["files"].items():
        assert entry["sha256"] == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    (tmp_path / "report.json").write_text('{"psnr": 99}')
    with pytest.raises(SceneError, match=r"report\.json is damaged"):
        load_scene(tmp_path)


def test_nothing_but_the_scene_is_left_behind(tmp_path: Path) -> None:
    save_scene(tmp_path, random_scene())
    save_scene(tmp_path, random_scene(seed=1))
    assert sorted(path.name for path in tmp_path.iterdir()) == [MANIFEST_FILE, SCENE_FILE]
    assert load_scene(tmp_path).seed == 1


@pytest.mark.parametrize("place", [20, -5], ids=["header", "numbers"])
def test_one_flipped_bit_is_found(tmp_path: Path, place: int) -> None:
    save_scene(tmp_path, random_scene())
    data = bytearray((tmp_path / SCENE_FILE).read_bytes())
    data[place] ^= 1
    (tmp_path / SCENE_FILE).write_bytes(data)
    with pytest.raises(SceneError, match="damaged"):
        load_scene(tmp_path)


@pytest.mark.parametrize("kind", ["fdm-quartic", "pfs", "hexplane"])
def test_a_scene_of_a_variant_is_refused_with_the_laboratory_that_knows_it(tmp_path: Path, kind: str) -> None:
    save_scene(tmp_path, random_scene(kind))
    program = f"""
from pathlib import Path
from contract.wire.errors import SceneError
from worker.scene.checkpoint import load_scene
try:
    load_scene(Path({str(tmp_path)!r}))
except SceneError as error:
    print(error)
from worker.evaluate.variants import register_variants
register_variants()
print(load_scene(Path({str(tmp_path)!r})).deformation.kind)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    refused, loaded = done.stdout.splitlines()
    assert kind in refused
    assert "register_variants() of worker.evaluate.variants" in refused
    assert loaded == kind


@pytest.mark.parametrize("missing", [SCENE_FILE, MANIFEST_FILE])
def test_a_missing_file_is_named(tmp_path: Path, missing: str) -> None:
    save_scene(tmp_path, random_scene())
    (tmp_path / missing).unlink()
    with pytest.raises(SceneError, match=missing):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "version 99"),
        ({"version": 1}, "has format version 1; this program reads version 2. Reconstruct the clip again"),
        ({"format": "other"}, "not the manifest of a scene"),
        ({"deformation": "wavelets"}, "motion 'wavelets'.*register_motion"),
        ({"deformation": "fdm-gaussian"}, "must share one shape"),
        ({"deformation": "pfs"}, "do not make a pfs"),
        ({"tensors": {}}, "gaussians.mean"),
        ({"intrinsics": {"width": -1}}, "does not fit its manifest"),
        ({"units_per_mm": 0.0}, "units_per_mm"),
        ({"units_per_mm": math.inf}, "units_per_mm is inf"),
        ({"units_per_mm": 10**400}, "does not fit its manifest"),
        ({"frame_times_s": [math.nan] * 6}, "frame_times_s holds numbers that are NaN"),
        ({"frame_times_s": [[0.0]] * 6}, "frame_times_s"),
        ({"world_from_camera": [[[math.inf] * 4] * 4] * 6}, "world_from_camera holds numbers"),
        ({"world_from_camera": [], "frame_times_s": []}, "world_from_camera"),
        ({"trained_t": [0.0, math.nan]}, "trained_t"),
        ({"trained_t": [1.0]}, "trained_t are not times of its 6 frames"),
        ({"trained_t": []}, "trained_t"),
        ({"gaussians": 12}, "11 Gaussians of kind shared are not those"),
        ({"seed": math.inf}, "does not fit its manifest"),
        ({"files": {"\0": {}}}, "does not fit its manifest"),
        ({"frame_times_s": [0.0]}, "world_from_camera"),
        ({"files": {"../scene.safetensors": {}}}, "not the name of a file"),
        ({"files": {}}, "does not fit its manifest"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_a_manifest_that_lies_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    save_scene(tmp_path, random_scene())
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest | change))
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path)


@pytest.mark.parametrize("text", ["{", "[" * 100_000], ids=["cut", "deep"])
def test_a_manifest_that_is_no_json_is_refused(tmp_path: Path, text: str) -> None:
    save_scene(tmp_path, random_scene())
    (tmp_path / MANIFEST_FILE).write_text(text)
    with pytest.raises(SceneError, match="damaged"):
        load_scene(tmp_path)


def forge(directory: Path, name: str, tensor: torch.Tensor) -> None:
    """Another tensor in the scene of a folder, with a manifest that lists it."""
    content = save(load((directory / SCENE_FILE).read_bytes()) | {name: tensor})
    manifest = json.loads((directory / MANIFEST_FILE).read_text())
    dtype = str(tensor.dtype).removeprefix("torch.")
    manifest["tensors"][name] = {"shape": list(tensor.shape), "dtype": dtype}
    manifest["files"][SCENE_FILE] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (directory / SCENE_FILE).write_bytes(content)
    (directory / MANIFEST_FILE).write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("gaussians.sh", torch.zeros(11), "sh is float32"),
        ("gaussians.sh", torch.tensor(1.0), "sh is float32"),
        ("gaussians.mean", torch.tensor(1.0), "does not fit its manifest|mean is float32"),
        ("gaussians.mean", torch.zeros(11, 3, dtype=torch.int32), "mean is int32"),
        ("gaussians.log_scale", torch.full((11, 3), torch.inf), "log_scale holds 33"),
        ("gaussians.opacity_logit", torch.full((11,), torch.nan), "opacity_logit holds 11"),
        ("gaussians.more", torch.zeros(11), "does not fit its manifest"),
        ("deformation.weight", torch.zeros(11, 10, 5, dtype=torch.int64), "weight of int64"),
        ("deformation.weight", torch.zeros(11, 10, 5, dtype=torch.float64), "weight of float64"),
        ("deformation.weight", torch.tensor(0.0), "does not fit its manifest"),
        ("deformation.centre", torch.tensor(0.0), "does not fit its manifest"),
        ("seen", torch.full((11,), 1.5), "seen lies in 1.5 to 1.5"),
        ("seen", torch.full((11,), -0.1), "seen lies in"),
        ("seen", torch.tensor(1.0), "seen is float32"),
    ],
)  # fmt: skip
def test_tensors_that_a_manifest_vouches_for_are_looked_at_all_the_same(
    tmp_path: Path, name: str, tensor: torch.Tensor, message: str
) -> None:
    save_scene(tmp_path, random_scene())
    forge(tmp_path, name, tensor)
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path)


def test_no_stored_tensors_are_not_taken_for_exact_ones(tmp_path: Path) -> None:
    save_scene(tmp_path, dataclasses.replace(random_scene(), stored={}))
    with pytest.raises(SceneError, match="is missing"):
        load_scene(tmp_path)


def test_what_is_not_finite_is_never_written_nor_loaded(tmp_path: Path) -> None:
    scene = random_scene()
    scene.gaussians.mean[3, 1] = torch.nan
    with pytest.raises(SceneError, match=r"gaussians\.mean holds 1 values that are NaN"):
        save_scene(tmp_path / "never", scene)
    assert not (tmp_path / "never").exists()


def test_tensors_that_do_not_belong_together_are_not_written(tmp_path: Path) -> None:
    scene = random_scene()
    with pytest.raises(SceneError, match="seen is float32"):
        save_scene(tmp_path, dataclasses.replace(scene, seen=torch.ones(3)))
    with pytest.raises(SceneError, match="seen is float64"):
        save_scene(tmp_path, dataclasses.replace(scene, seen=scene.seen.double()))
    with pytest.raises(SceneError, match="moves 4 Gaussians"):
        save_scene(tmp_path, dataclasses.replace(scene, deformation=random_scene(count=4).deformation))
    assert not list(tmp_path.iterdir())


def test_a_training_state_comes_back_with_every_type(tmp_path: Path) -> None:
    flat = torch.randn(10)
    tensors = {
        "moment": flat[:4],
        "other": flat[4:],
        "order": torch.arange(5),
        "random": torch.get_rng_state(),
        "used": torch.tensor([True, False]),
        "step": torch.tensor(7, dtype=torch.int64),
        "exact": torch.randn(3, dtype=torch.float64),
        "none": torch.empty(0, 3),
    }
    state = {"iteration": 12, "t_train_s": 3.25, "settings": {"preset": "fast"}}
    begin_resume(tmp_path, tensors, {"iteration": 0})()
    begin_resume(tmp_path, tensors, state)()
    loaded, loaded_state = load_resume(tmp_path)
    assert loaded_state == state
    assert loaded.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert loaded[name].dtype == tensor.dtype
        assert torch.equal(loaded[name], tensor)


def test_a_training_state_of_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr("worker.scene.resume_file.RESUME_VERSION", RESUME_VERSION - 1)
        begin_resume(tmp_path, {"moment": torch.ones(4)}, {"iteration": 12})()
    with pytest.raises(SceneError, match=rf"another version \({RESUME_VERSION - 1}; .* {RESUME_VERSION}\)"):
        load_resume(tmp_path)


def test_a_damaged_training_state_is_refused(tmp_path: Path) -> None:
    begin_resume(tmp_path, {"moment": torch.ones(4)}, {"iteration": 12})()
    path = tmp_path / RESUME_FILE
    whole = path.read_bytes()
    for broken in (whole[:-1], whole[:-1] + b"\x01", whole.replace(b"12", b"13"), whole[:4], b""):
        path.write_bytes(broken)
        with pytest.raises(SceneError, match="damaged"):
            load_resume(tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(SceneError, match="cannot be read"):
        load_resume(tmp_path)
