"""What goes into the HTML file of a scene, and what is refused."""

from __future__ import annotations

import re
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from client.page import DASHBOARD
from intrasplat.errors import InputError, SceneError, UnavailableError
from intrasplat.names import RECORDED
from intrasplat.scene.recorded_file import name_of
from intrasplat.scene.stored_exports import stored_parts
from tests.archives import ORIGIN, small_scene, stored
from tests.intrasplat.scenes import random_scene


def test_what_cannot_be_shown_so_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hexplane") as refused:
        stored_parts("html", stored(tmp_path / "planes", random_scene("hexplane")), None, DASHBOARD)
    assert refused.value.field == "format"
    with pytest.raises(SceneError):
        stored_parts("html", tmp_path, None, DASHBOARD)
    with pytest.raises(InputError, match="no recorded frames"):
        stored_parts("html", stored(tmp_path / "plain", small_scene()), None, DASHBOARD, recorded="on")
    with pytest.raises(UnavailableError, match="INTRASPLAT_DASHBOARD_DIR"):
        stored_parts("html", stored(tmp_path / "scene", small_scene()), None, tmp_path)


@pytest.mark.parametrize("damage", ["directory", "picture", "encrypted", "cut"])
def test_damaged_recorded_frames_stop_only_who_asks_for_them(tmp_path: Path, damage: str) -> None:
    folder, name = stored(tmp_path / "scene", small_scene()), name_of("left", 1, "jpg")
    with zipfile.ZipFile(folder / RECORDED, "w") as archive:
        archive.writestr(name, 90 * b"picture")
    sound = (folder / RECORDED).read_bytes()
    listed = sound.index(b"PK\x01\x02")
    spoilt = bytearray(sound)
    if damage == "directory":
        spoilt = spoilt[:listed]
    elif damage == "picture":
        spoilt[listed - 1] ^= 1
    elif damage == "encrypted":
        spoilt[6], spoilt[listed + 8] = 1, 1
    else:
        spoilt[listed + 20 : listed + 28] = 2 * (2 * len(sound)).to_bytes(4, "little")
    whole = b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD))
    assert f'{{"{name}": "'.encode() in whole
    (folder / RECORDED).write_bytes(spoilt)
    assert b'"state": "damaged"' in b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD))
    assert b'"state": "off"' in b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD, recorded="off"))
    with pytest.raises(SceneError, match="cannot be read"):
        stored_parts("html", folder, ORIGIN, DASHBOARD, recorded="on")


def test_pictures_are_read_one_by_one_while_the_file_is_sent(tmp_path: Path) -> None:
    folder, count, size = stored(tmp_path / "scene", small_scene()), 12, 4_000_000
    names = [name_of("left", frame, "jpg") for frame in range(count)]
    with zipfile.ZipFile(folder / RECORDED, "w") as archive:
        for name in names:
            archive.writestr(name, bytes(size))
    tracemalloc.start()
    content, length = re.compile(rb'"(left/\d+\.jpg)": "'), 0
    found = []
    for part in stored_parts("html", folder, ORIGIN, DASHBOARD, recorded="on"):
        found += content.findall(part[:100])
        length += len(part)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [name.decode() for name in found] == names
    assert length > count * size * 4 / 3
    assert peak < 10 * size
