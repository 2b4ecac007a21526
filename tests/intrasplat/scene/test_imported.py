"""A scene of another installation: its tensors and renders are the same here, and what means harm is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.names import CURVE, MANIFEST, MASKS, RECORDED, REPORT, SCENE, THUMBNAIL
from intrasplat.notices import NoticeCode
from intrasplat.report import Imported, Report
from intrasplat.scene.archive import read_archive
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.imported import take_scene
from intrasplat.view.render import render_frame
from tests.archives import HOSTILE, ORIGIN, Files, archived, files_of, relisted, small_scene, zipped
from tests.intrasplat.scenes import KINDS, random_scene

MAX_BYTES = 64 << 20
FROM = Imported(scene_id=ORIGIN, version="0.3.0", exported_at_s=5.0, imported_at_s=6.0)


def taken(tmp_path: Path, content: bytes, limits: ClipLimits | None = None) -> tuple[Report, Path]:
    """The report and the folder of an archive that was taken in."""
    archive, folder = tmp_path / "scene.zip", tmp_path / "taken"
    archive.write_bytes(content)
    folder.mkdir()
    return take_scene(archive, folder, FROM, limits or ClipLimits(), MAX_BYTES), folder


@pytest.mark.parametrize("kind", [*KINDS, "compact"])
def test_a_scene_renders_to_the_same_bits_where_it_was_imported(tmp_path: Path, kind: str) -> None:
    scene = small_scene() if kind == "compact" else random_scene(kind, sh_degree=1)
    content = archived(tmp_path / "there", scene)
    report, folder = taken(tmp_path, content)
    before, after = load_scene(tmp_path / "there"), load_scene(folder)
    assert (folder / SCENE).read_bytes() == (tmp_path / "there" / SCENE).read_bytes()
    for t, pose in ((0.0, None), (0.7, before.world_from_camera[2])):
        first, second = render_frame(before, t, pose), render_frame(after, t, pose)
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.depth_mm, second.depth_mm)
    assert report.imported == FROM
    assert report.psnr_tissue_db == 36.2
    assert [each.code for each in report.assumptions] == [NoticeCode.IMPORTED]
    assert Report.model_validate_json((folder / REPORT).read_bytes()) == report
    assert (folder / CURVE).read_bytes() == (tmp_path / "there" / CURVE).read_bytes()


def test_what_no_reader_of_ours_knows_is_not_kept(tmp_path: Path) -> None:
    files = files_of(archived(tmp_path / "there", small_scene()))
    manifest = json.loads(files[MANIFEST]) | {"more": "<script>"}
    files = relisted({**files, MANIFEST: json.dumps(manifest).encode(), THUMBNAIL: b"of something else"})
    _, folder = taken(tmp_path, zipped(files))
    kept = json.loads((folder / MANIFEST).read_text())
    assert "more" not in kept
    assert kept["settings"] == {"pose_warnings": [], "motion_error": 0.0}
    assert sorted(path.name for path in folder.iterdir()) == sorted([SCENE, MANIFEST, REPORT, CURVE])


def test_a_scene_that_was_exported_before_its_scores_says_so(tmp_path: Path) -> None:
    report, _ = taken(tmp_path, archived(tmp_path / "there", small_scene(), scored=False))
    assert report.scored
    assert report.warnings[-1].code is NoticeCode.SCORES_FAILED


def test_an_import_of_an_import_names_the_last_place(tmp_path: Path) -> None:
    earlier = FROM.model_copy(update={"scene_id": "f" * 32})
    content = archived(tmp_path / "there", small_scene(), imported=earlier)
    report, _ = taken(tmp_path, content)
    assert report.imported == FROM
    assert len(report.assumptions) == 1


def test_found_masks_and_recorded_frames_come_along(tmp_path: Path) -> None:
    png = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (64).to_bytes(4, "big") + (48).to_bytes(4, "big") + b"\x08\x02\0\0\0"
    pictures = {MASKS: zipped({"000000.png": png}), RECORDED: zipped({"left/000000.jpg": b"\xff\xd8\xff\xe0"})}
    files = relisted({**files_of(archived(tmp_path / "there", small_scene())), **pictures})
    _, folder = taken(tmp_path, zipped(files))
    assert {name: (folder / name).read_bytes() for name in pictures} == pictures
    beside = json.loads((folder / MANIFEST).read_bytes())["beside"]
    assert {name: each["bytes"] for name, each in beside.items()} == {name: len(pictures[name]) for name in pictures}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_archives_are_refused_before_a_number_is_read(tmp_path: Path, name: str) -> None:
    make, problem = HOSTILE[name]
    files = files_of(archived(tmp_path / "there", small_scene(50)))
    path = tmp_path / "scene.zip"
    path.write_bytes(make(files))
    with pytest.raises(InputError, match=problem) as refused:
        read_archive(path, MAX_BYTES)
    assert refused.value.field == "scene"
    assert refused.value.remedy


def with_manifest(**changes: object) -> Callable[[Files], Files]:
    def changed(files: Files) -> Files:
        return {**files, MANIFEST: json.dumps(json.loads(files[MANIFEST]) | changes).encode()}

    return changed


def with_tensors(change: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[Files], Files]:
    """The same files with other tensors, and a manifest that fits them."""

    def changed(files: Files) -> Files:
        tensors = load(files[SCENE])
        change(tensors)
        content = save(tensors)
        manifest = json.loads(files[MANIFEST])
        manifest["files"] = {SCENE: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}}
        manifest["tensors"] = {
            name: {"shape": list(each.shape), "dtype": str(each.dtype).removeprefix("torch.")}
            for name, each in tensors.items()
        }
        return {**files, SCENE: content, MANIFEST: json.dumps(manifest).encode()}

    return changed


def with_header(header: bytes) -> Callable[[Files], Files]:
    """A file of tensors with that header."""

    def changed(files: Files) -> Files:
        content = len(header).to_bytes(8, "little") + header
        listed = {SCENE: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}}
        manifest = json.loads(files[MANIFEST]) | {"files": listed}
        return {**files, SCENE: content, MANIFEST: json.dumps(manifest).encode()}

    return changed


STILL = np.eye(4).tolist()
SPOILT: dict[str, tuple[Callable[[Files], Files], str]] = {
    "another version": (with_manifest(version=99), "format version 99"),
    "an unknown motion": (with_manifest(deformation="wavelets"), "motion 'wavelets'"),
    "a variant": (with_manifest(preset="hexplane"), "hexplane is a variant of the laboratory"),
    "another coding": (with_manifest(coding="zip"), "coding"),
    "more Gaussians": (with_manifest(gaussians=51), "Gaussians"),
    "no tensors listed": (with_manifest(tensors={}), "not those its manifest lists"),
    "a file elsewhere": (
        with_manifest(files={"../../keys.json": {"bytes": 1, "sha256": "0"}}),
        "not the name of a file",
    ),
    "no files": (with_manifest(files={}), "does not fit"),
    "a camera of text": (with_manifest(intrinsics={"width": "<b>"}), "camera"),
    "a huge camera": (
        with_manifest(intrinsics={"width": 99999, "height": 99999, "fx": 1, "fy": 1, "cx": 1, "cy": 1}),
        "the limit is",
    ),
    "poses of NaN": (with_manifest(world_from_camera=[[[float("nan")] * 4] * 4] * 6), "NaN"),
    "poses that squeeze": (with_manifest(world_from_camera=[(2 * np.eye(4)).tolist()] * 6), "no rotations"),
    "poses that mirror": (with_manifest(world_from_camera=[np.diag([1, 1, -1, 1]).tolist()] * 6), "no rotations"),
    "too few poses": (with_manifest(world_from_camera=[STILL]), "shape"),
    "frames without end": (
        with_manifest(world_from_camera=[STILL] * 1001, frame_times_s=list(range(1001)), trained_t=[0.0]),
        "the limit is 1000",
    ),
    "an hour": (with_manifest(frame_times_s=[600.0 * each for each in range(6)]), "the limit is 600 s"),
    "times that stand": (with_manifest(frame_times_s=[0.0] * 6), "rise"),
    "a scale of 0": (with_manifest(units_per_mm=0), "units_per_mm"),
    "a scale of infinity": (with_manifest(units_per_mm=float("inf")), "units_per_mm"),
    "an error of motion that is none": (with_manifest(settings={"motion_error": -1}), "settings"),
    "warnings that are none": (with_manifest(settings={"pose_warnings": [{"code": "<b>"}]}), "settings"),
    "warnings without end": (
        with_manifest(settings={"pose_warnings": [{"code": "pose_jitter", "severity": "warning", "text": "x" * 5000}]}),
        "manifest.json is longer than 4000 characters",
    ),
    "settings that are none": (with_manifest(settings=[1]), "does not fit|settings"),
    "a number that is none": (with_tensors(lambda each: each["step"].fill_(float("nan"))), "NaN"),
    "a count beyond all memory": (with_tensors(lambda each: each["count"].fill_(2**40)), "does not fit"),
    "a negative count": (with_tensors(lambda each: each["count"].fill_(-1)), "does not fit"),
    "no code": (with_tensors(lambda each: each.update({"code.0": each["code.0"][:0].clone()})), "does not fit"),
    "a code of zeros": (with_tensors(lambda each: each["code.1"].zero_()), "does not fit"),
    "a tensor more": (with_tensors(lambda each: each.update(extra=torch.zeros(3))), "does not fit"),
    "a header of nothing": (with_header(b"{}"), "not those its manifest lists"),
    "a header of lists": (with_header(b"[" * 90_000), "damaged"),
    "offsets beyond the file": (
        with_header(b'{"step":{"dtype":"F32","shape":[4611686018427387904],"data_offsets":[0,16]}}'),
        "damaged",
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_scene_that_cannot_be_shown_is_refused_with_what_is_wrong(tmp_path: Path, name: str) -> None:
    spoil, problem = SPOILT[name]
    files = files_of(archived(tmp_path / "there", small_scene(50)))
    with pytest.raises(InputError, match=problem) as refused:
        taken(tmp_path, zipped(relisted(spoil(files))))
    assert refused.value.field == "scene"
    assert refused.value.remedy
    assert str(tmp_path) not in refused.value.problem


def test_a_scene_without_gaussians_and_a_report_of_another_scene_are_refused(tmp_path: Path) -> None:
    scene = random_scene("pfs")
    none = dataclasses.replace(
        scene,
        gaussians=dataclasses.replace(
            scene.gaussians, **{name: each[:0] for name, each in scene.gaussians.tensors().items()}
        ),
        deformation=scene.deformation.select(torch.zeros(0, dtype=torch.int64)),
        seen=scene.seen[:0],
    )
    with pytest.raises(InputError, match="no Gaussians"):
        taken(tmp_path, archived(tmp_path / "there", none))
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(InputError, match="The report says gaussians 7, the scene has 11"):
        taken(other, archived(other / "there", scene, gaussians=7))


def test_an_archive_larger_than_an_upload_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.zip"
    path.write_bytes(archived(tmp_path / "there", small_scene()))
    with pytest.raises(InputError, match="the limit is 1000"):
        read_archive(path, 1000)


def test_any_unzip_reads_the_archive(tmp_path: Path) -> None:
    content = archived(tmp_path / "there", small_scene())
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist()[-1] == "archive.json"
        head: dict[str, Any] = json.loads(archive.read("archive.json"))
        for name, listed in head["files"].items():
            assert hashlib.sha256(archive.read(name)).hexdigest() == listed["sha256"]
            assert archive.read(name) == (tmp_path / "there" / name).read_bytes()
    assert head["scene_id"] == ORIGIN
