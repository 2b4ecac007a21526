"""The hostile corpus, through the decoding process: a clear error each, and the next clip is read as ever."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intrasplat.clip import DepthClip
from intrasplat.decode import StereoRecording, decode_clip
from intrasplat.decode.contained import Decoder
from intrasplat.decode.decoding import allowance_of
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.sniff import check_file
from intrasplat.options import ClipOptions
from tests.intrasplat.clip.hostile import CALIBRATION, CORPUS, VIDEO, Hostile, endonerf, npy

AT_ONCE = 2
"""Decoding processes: most of a refusal is the time that one takes to start."""
READ_ALL = """
from intrasplat.decode.child import _described, serve


def work_of():
    from intrasplat.decode.reading import read_clip

    def read_all(request, folder, reports):
        errors = {}
        for name, paths in request["files"].items():
            own = folder / str(len(errors))
            own.mkdir()
            try:
                errors[name] = {"read": read_clip(request | {"paths": paths}, own, reports)}
            except Exception as error:
                errors[name] = _described(error)
        return errors

    return read_all


serve(work_of)
"""
"""A decoder that reads one clip after the other, confined as ever, and answers with what is wrong with each."""


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[object]]]:
    """What becomes of every file of the corpus: of those that a look at their bytes or directory refuses, in one
    decoder, to which that look is left; of each other in a decoder of its own.
    """
    program = tmp_path_factory.mktemp("program") / "read_all.py"
    program.write_text(READ_ALL)
    files = {name: given(tmp_path_factory.mktemp("hostile"), hostile) for name, hostile in CORPUS.items()}
    early = [name for name, hostile in CORPUS.items() if hostile.refused_at == "upload"]
    with ThreadPoolExecutor(AT_ONCE) as threads:
        answers = threads.submit(read_all, program, {name: files[name] for name in early})
        yield {
            name: threads.submit(answer, answers, name) if name in early else threads.submit(read_whole, **files[name])
            for name in CORPUS
        }


def read_all(program: Path, files: dict[str, dict[str, Path]]) -> dict[str, Any]:
    """What one decoder says of each of these clips."""
    limits = ClipLimits()
    paths = {
        name: {"path" if part == "clip" else part: str(path) for part, path in each.items()}
        for name, each in files.items()
    }
    request = {
        "files": paths,
        "options": ClipOptions().model_dump(include=set(ClipOptions.model_fields)),
        "layouts": [],
        "readable": sorted({path for each in paths.values() for path in each.values()}),
        "limits": limits.numbers(),
    }
    with closing(Decoder((str(program),))) as decoder:
        decoder.ask(request, allowance_of(limits))
        return decoder.until_ended()


def answer(answers: Future[dict[str, Any]], name: str) -> None:
    """Raises what a decoder of its own would."""
    answered = answers.result()[name]
    assert "kind" in answered, f"{name} is read"
    assert answered["kind"] in ("input", "limit"), answered
    raise InputError(*(answered[each] for each in ("field", "problem", "remedy")))


def read_whole(**files: Path) -> StereoRecording | DepthClip:
    """The clip, after its last frame."""
    decoded = decode_clip(**files)
    if isinstance(decoded, StereoRecording):
        for _ in decoded.clip.pairs():
            pass
    return decoded


def given(tmp_path: Path, hostile: Hostile) -> dict[str, Path]:
    """The hostile file as its part, good files for the others."""
    (tmp_path / "good.json").write_bytes(CALIBRATION)
    return {"clip": VIDEO, "calibration": tmp_path / "good.json"} | {hostile.part: hostile.write(tmp_path)}


@pytest.mark.parametrize("name", CORPUS)
def test_a_hostile_file_is_refused_with_its_field_and_a_remedy(refused: dict[str, Future[object]], name: str) -> None:
    hostile = CORPUS[name]
    with pytest.raises(InputError, match=hostile.problem) as caught:
        refused[name].result()
    assert caught.value.field == hostile.part
    assert caught.value.remedy
    assert "crashed" not in caught.value.problem


@pytest.mark.parametrize("name", CORPUS)
def test_what_shows_without_a_decoder_is_refused_without_one(tmp_path: Path, name: str) -> None:
    hostile = CORPUS[name]
    path = hostile.write(tmp_path)
    if hostile.refused_at == "decoding":
        check_file(path, hostile.part, ClipLimits())
        return
    with pytest.raises(InputError, match=hostile.problem) as caught:
        check_file(path, hostile.part, ClipLimits())
    assert caught.value.field == hostile.part


def test_after_all_that_a_clip_is_read(tmp_path: Path) -> None:
    (tmp_path / "good.json").write_bytes(CALIBRATION)
    decoded = decode_clip(VIDEO, calibration=tmp_path / "good.json")
    assert isinstance(decoded, StereoRecording)
    assert decoded.clip.frame_count == 12


@pytest.mark.parametrize(
    ("name", "content"), [("clip.mkv", VIDEO.read_bytes()), ("clip.mp4", b"PK\x05\x06" + bytes(18))]
)
def test_a_file_that_bears_the_ending_of_another_kind_is_refused_when_it_arrives(
    tmp_path: Path, name: str, content: bytes
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match="Give the file the ending of what it is"):
        check_file(path, "clip", ClipLimits())


@pytest.mark.parametrize(
    "path", sorted(VIDEO.parent.glob("*.m*")) + sorted(VIDEO.parent.glob("*.webm")), ids=lambda path: path.name
)
def test_videos_of_every_container_pass(path: Path) -> None:
    check_file(path, "clip", ClipLimits())


@pytest.mark.parametrize("name", ["stereo_sbs_h264.mp4", "stereo_tb_hevc.mov", "stereo_sbs_varying.mkv", "clip.zip"])
def test_whatever_happens_to_its_bytes_a_file_passes_or_is_refused(
    tmp_path: Path, rng: np.random.Generator, name: str
) -> None:
    good = endonerf(npy(np.zeros((1, 17)))) if name == "clip.zip" else (VIDEO.parent / name).read_bytes()
    path = tmp_path / name
    refused = 0
    for _ in range(150):
        data = bytearray(good[: rng.integers(1, len(good))] if rng.random() < 0.2 else good)
        near_an_end = rng.random() < 0.7  # where headers and directories stand
        for _ in range(rng.integers(1, 8)):
            at = int(rng.integers(0, min(len(data), 2000) if near_an_end else len(data)))
            data[at if rng.random() < 0.5 else len(data) - 1 - at] = int(rng.integers(0, 256))
        path.write_bytes(data)
        try:
            check_file(path, "clip", ClipLimits())
        except InputError:
            refused += 1
    assert 0 < refused <= 150
