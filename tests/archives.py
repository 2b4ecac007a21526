"""Scenes as another installation exports them, sound and spoilt."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import stat
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from intrasplat.names import CURVE, MANIFEST, REPORT, SCENE
from intrasplat.report import Report
from intrasplat.scene.archive import ARCHIVE, archive_parts
from intrasplat.scene.checkpoint import save_scene
from intrasplat.scene.scene import TrainedScene
from tests.intrasplat.scene.compacting import compacted
from tests.intrasplat.scenes import random_scene
from tests.reports import REPORT_OF_A_SCENE, a_warning

ORIGIN = "0123456789abcdef" * 2
Files = dict[str, bytes]


def small_scene(count: int = 300) -> TrainedScene:
    """A compact scene of some hundred Gaussians."""
    scene = random_scene(count=count)
    wide = dataclasses.replace(scene.gaussians, mean=scene.gaussians.mean * scene.gaussians.mean.new([12, 9, 1]))
    return compacted(dataclasses.replace(scene, gaussians=wide))


def report_of(scene: TrainedScene, **changes: object) -> Report:
    fitting = {
        "gaussians": len(scene.gaussians),
        "frame_count": scene.frame_count,
        "width": scene.intrinsics.width,
        "height": scene.intrinsics.height,
        "warnings": (a_warning("<img src=x onerror=alert(1)> Smith & Sons"),),
    }
    return REPORT_OF_A_SCENE.model_copy(update={**fitting, **changes})


def stored(folder: Path, scene: TrainedScene, **changes: object) -> Path:
    """A scene's folder as a worker leaves it. changes: of its report."""
    save_scene(folder, scene)
    (folder / REPORT).write_text(report_of(scene, **changes).model_dump_json(indent=1))
    (folder / CURVE).write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n2.5,36.2000,\n")
    return folder


def archived(folder: Path, scene: TrainedScene, **changes: object) -> bytes:
    """The archive of a scene that is stored in the folder."""
    return b"".join(archive_parts(stored(folder, scene, **changes), ORIGIN))


def files_of(archive: bytes) -> Files:
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        return {name: opened.read(name) for name in opened.namelist()}


def zipped(files: Mapping[str, bytes], *, compression: int = zipfile.ZIP_STORED, kind: int = stat.S_IFREG) -> bytes:
    """A zip of these files under exactly these names. kind: of the first."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for index, (name, content) in enumerate(files.items()):
            entry = zipfile.ZipInfo("placeholder")
            entry.filename, entry.compress_type, entry.create_system = name, compression, 3
            entry.external_attr = ((stat.S_IFREG if index else kind) | 0o644) << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def relisted(files: Files) -> Files:
    """The same files, with an archive.json that lists them as they are."""
    head = json.loads(files[ARCHIVE])
    head["files"] = {
        name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in files.items()
        if name != ARCHIVE
    }
    return {**files, ARCHIVE: json.dumps(head).encode()}


def with_json(name: str, change: Callable[[Any], object]) -> Callable[[Files], bytes]:
    """An archive in which one JSON file was changed, and the hashes with it."""

    def made(files: Files) -> bytes:
        document = json.loads(files[name])
        change(document)
        return zipped(relisted({**files, name: json.dumps(document).encode()}))

    return made


def with_files(**changes: bytes | None) -> Callable[[Files], bytes]:
    """An archive in which files were replaced, with their hashes. Names have _ for the dot; None: it is left out."""

    def made(files: Files) -> bytes:
        named = {name.replace("_", "."): content for name, content in changes.items()}
        return zipped(relisted({name: each for name, each in {**files, **named}.items() if each is not None}))

    return made


def patched(data: bytes, sign: bytes, offset: int, value: bytes) -> bytes:
    at = data.index(sign) + offset
    return data[:at] + value + data[at + len(value) :]


def first_renamed(name: str) -> Callable[[Files], bytes]:
    return lambda files: zipped({name if each == MANIFEST else each: content for each, content in files.items()})


def twice(files: Files) -> bytes:
    return zipped({**files, "MANIFEST.JSON": files[MANIFEST]})


def overlapping(files: Files) -> bytes:
    """Two members share their bytes."""
    content = zipped(files)
    second = content.index(b"PK\x01\x02", content.index(b"PK\x01\x02") + 4)
    return content[: second + 42] + bytes(4) + content[second + 46 :]


def nested(levels: int) -> bytes:
    return b'{"a":' * levels + b"1" + b"}" * levels


HOSTILE: dict[str, tuple[Callable[[Files], bytes], str]] = {
    "no zip": (lambda files: b"no zip", "not a readable zip"),
    "cut short": (lambda files: zipped(files)[:-400], "not a readable zip"),
    "nothing in it": (lambda files: zipped({}), "has no archive.json"),
    "another zip": (lambda files: zipped({"left/000.png": b"x"}), "no file of a scene"),
    "a file more": (lambda files: zipped({**files, "evil.py": b"x"}), "no file of a scene"),
    "out of the folder": (first_renamed("../manifest.json"), r'"\.\."'),
    "absolute": (first_renamed("/etc/manifest.json"), "absolute path"),
    "backslashes": (first_renamed("..\\manifest.json"), r'"\.\."'),
    "a subfolder": (first_renamed("scene/manifest.json"), "no file of a scene"),
    "a link": (lambda files: zipped(files, kind=stat.S_IFLNK), "symbolic link"),
    "a device": (lambda files: zipped(files, kind=stat.S_IFCHR), "not a plain file"),
    "encrypted": (lambda files: patched(zipped(files), b"PK\x01\x02", 8, b"\x01"), "encrypted"),
    "twice in other case": (twice, "twice"),
    "overlapping": (overlapping, "overlap"),
    "a zip in it": (lambda files: zipped({**files, "more.zip": zipped({"a": b"b"})}), "archive inside"),
    "compressed": (lambda files: zipped(files, compression=zipfile.ZIP_DEFLATED), "is compressed"),
    "a bomb": (
        lambda files: zipped({**files, REPORT: bytes(30 << 20)}, compression=zipfile.ZIP_DEFLATED),
        "inflates from",
    ),
    "a large text": (with_files(report_json=b'"' + b"x" * (9 << 20) + b'"'), "bytes; the limit is"),
    "no scene": (with_files(scene_safetensors=None), "has no scene.safetensors"),
    "no report": (with_files(report_json=None), "has no report.json"),
    "other bytes": (lambda files: zipped({**files, SCENE: files[SCENE][:-1] + b"x"}), "not what was exported"),
    "a list that lacks a file": (
        lambda files: zipped({**files, ARCHIVE: relisted({k: v for k, v in files.items() if k != CURVE})[ARCHIVE]}),
        "does not list",
    ),
    "a later version": (with_json(ARCHIVE, lambda head: head.update(version=2)), "version"),
    "a version of markup": (with_json(ARCHIVE, lambda head: head.update(intrasplat="<b>0.3</b>")), "intrasplat"),
    "an origin of markup": (with_json(ARCHIVE, lambda head: head.update(scene_id="<script>")), "scene_id"),
    "a time that is none": (
        lambda files: zipped({**files, ARCHIVE: files[ARCHIVE].replace(b'_at_s": ', b'_at_s": 1e999, "x": ')}),
        "exported_at_s",
    ),
    "not UTF-8": (with_files(report_json=b"\xff\xfe"), "not UTF-8"),
    "a deep report": (with_files(report_json=nested(5000)), "levels deep"),
    "a deep manifest": (with_files(manifest_json=nested(100_000)), "levels deep"),
    "no report in it": (with_files(report_json=b"{}"), "report.json: "),
    "a report of NaN": (
        with_json(REPORT, lambda report: report.update(psnr_tissue_db=float("nan"))),
        "report.json: psnr_tissue_db",
    ),
    "an endless text": (with_json(REPORT, lambda report: report.update(notice="x" * 5000)), "longer than"),
    "control characters": (with_json(REPORT, lambda report: report.update(device="\x1b[2J")), "control characters"),
    "another manifest": (with_json(MANIFEST, lambda manifest: manifest.update(format="x")), "manifest.json: format"),
    "another preset": (with_json(MANIFEST, lambda manifest: manifest.update(preset="<b>")), "manifest.json: preset"),
    "a curve of formulas": (with_files(curve_csv=b"t_train_s,psnr_tissue_db\n=cmd(),3\n"), "finite numbers"),
    "a curve of markup": (with_files(curve_csv=b"<script>\n1\n"), "finite numbers"),
    "a curve of infinity": (with_files(curve_csv=b"t_train_s\ninf\n"), "finite numbers"),
    "an empty curve": (with_files(curve_csv=b""), "finite numbers"),
}
"""Archives that are refused before a number of the scene is read, each with what must be said of it."""
