"""Each variant of the corpus is accepted, mended with a notice, or refused with the field and the reason.

The table of docs/input.md is rendered from CORPUS: `python -m tests.intrasplat.clip.test_corpus` writes it again.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, StereoClip, find_calibration
from intrasplat.clip.calibration import load_calibration, rectify
from intrasplat.errors import InputError
from intrasplat.intake.sniff import check_file
from intrasplat.notices import NoticeCode
from tests.intrasplat.clip.corpus import CORPUS, Given, Variant
from tests.intrasplat.clips import open_with

PAGE = Path(__file__).parents[3] / "docs/input.md"
MARKS = "<!-- corpus -->\n", "<!-- /corpus -->\n"
MENDS = {NoticeCode(each.said) for each in CORPUS if each.outcome == "mended"}
MAX_LEVELS = 3.0
"""Mean error of a good encoder's 8-bit pictures. Fields, or another range or matrix of colours, cost more."""


def opened(given: Given) -> set[NoticeCode]:
    """The codes of the clip's notices. Its frames, times and cameras must be those of `given`."""
    clip = open_with(given.clip, right=given.right)
    assert isinstance(clip, StereoClip)
    notices = [*clip.assumptions, *clip.warnings]
    shown = list(clip.pairs())
    assert given.eyes is not None
    assert clip.frame_count == len(shown) == len(given.shown)
    for pair, index in zip(shown, given.shown, strict=True):
        for pixels, eye in zip(pair, given.eyes, strict=True):
            assert pixels.shape == eye[index].shape
            assert np.abs(pixels.astype(float) - eye[index]).mean() < MAX_LEVELS
    if given.times_ms is not None:
        np.testing.assert_allclose(clip.frame_times_s, np.subtract(given.times_ms, given.times_ms[0]) / 1000, atol=2e-3)
    path = given.calibration or find_calibration(given.clip)
    assert (path is None) == (given.cameras is None)
    if path is not None and given.cameras is not None:
        read = load_calibration(path, eye_width=clip.width, eye_height=clip.height)
        assert read.model_copy(update={"assumptions": (), "scaled_from": None}) == given.cameras
        rectified = rectify(clip, read)
        notices += [*rectified.assumptions, *rectified.warnings]
    return {each.code for each in notices}


def check_arrival(given: Given) -> None:
    """The checks of an upload."""
    for path, part in ((given.clip, "clip"), (given.right, "right"), (given.calibration, "calibration")):
        if path is not None and path.is_file():
            check_file(path, part, ClipLimits())


@pytest.mark.parametrize("variant", CORPUS, ids=lambda variant: variant.given)
def test_each_variant_has_its_outcome(tmp_path: Path, variant: Variant) -> None:
    given = variant.make(tmp_path)
    if variant.outcome == "refused":
        with pytest.raises(InputError) as caught:
            opened(given)
        assert caught.value.field == variant.field
        assert re.search(".*".join(map(re.escape, variant.said.split("…"))), caught.value.problem)
        assert caught.value.remedy
        with suppress(InputError):
            check_arrival(given)
        return
    check_arrival(given)
    codes = opened(given)
    mends = codes & MENDS - ({NoticeCode.FRAME_TIMES} if given.times_ms is None else set())
    assert mends == ({NoticeCode(variant.said)} if variant.outcome == "mended" else set())


def table() -> str:
    """The corpus as Markdown, one row for each kind, outcome and words."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for each in CORPUS:
        said = f"`{each.said}`" if each.outcome == "mended" else each.said and f"`{each.field}`: {each.said}"
        rows.setdefault((each.kind, each.outcome, said), []).append(each.given)
    lines = [f"| {kind}: {'; '.join(given)} | {outcome} | {said} |" for (kind, outcome, said), given in rows.items()]
    return "\n".join(["| given | outcome | what is said |", "|---|---|---|", *lines, ""])


def test_the_page_shows_the_corpus() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page.split(MARKS[0])[1].split(MARKS[1])[0] == table(), "run this module to write the table again"


if __name__ == "__main__":
    before, after = PAGE.read_text(encoding="utf-8").split(MARKS[0])
    PAGE.write_text(f"{before}{MARKS[0]}{table()}{MARKS[1]}{after.split(MARKS[1])[1]}", encoding="utf-8")
