"""Instruments of phantoms are found without masks, and nothing is masked where there is none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from intrasplat.clip import DepthClip
from intrasplat.clip.stored import load_clip, save_clip
from intrasplat.instruments import Finder, FoundMask, Looked, TissueLook, find_instruments, with_instruments_found
from intrasplat.instruments.depth_clip import nearness_of
from intrasplat.instruments.finder import MAX_MISSED, MAX_UNSURE
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.stereo import match_eyes
from lab.phantom import TOOLS, DrawnStereo, PhantomSettings, Tool, make_phantom

FRAMES = 9


@cache
def recording(*tools: Tool, seed: int = 3) -> DrawnStereo:
    """A stereo clip without masks, and where it shows tissue. Callers share the arrays."""
    settings = PhantomSettings(width=320, height=256, frames=FRAMES, seed=seed, tools=tools, period_frames=12.0)
    return make_phantom(settings).stereo_recording(masks=False)


@cache
def opened_alone(*tools: Tool) -> DepthClip:
    """The recording with instruments found. Callers share the arrays."""
    return opened(recording(*tools))


def opened(drawn: DrawnStereo, holdout: str = "every8", **named: object) -> DepthClip:
    asked = {"mask_source": "auto", **named}
    return match_eyes(drawn.clip, drawn.calibration, holdout, Hooks(), Timings(), **asked)  # type: ignore[arg-type]


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union of what is no tissue."""
    return float((~found & ~true).sum() / (~found | ~true).sum())


@pytest.mark.parametrize("tool", TOOLS)
def test_instruments_of_every_kind_are_found(tool: Tool) -> None:
    drawn, clip = recording(tool), opened_alone(tool)
    assert overlap(clip.tissue, drawn.tissue) > 0.85
    assert clip.masks is not None
    assert clip.masks.source == "found"
    assert clip.masks.share == pytest.approx(1 - clip.tissue.mean(), abs=1e-6)
    assert clip.masks.sure is not None
    assert clip.masks.sure > 0.7
    assert clip.right is not None
    assert not clip.right.tissue.all()
    assert [each.code for each in clip.assumptions].count(NoticeCode.MASKS) == 1


def test_nothing_is_masked_where_there_is_no_instrument() -> None:
    clip = opened(recording())
    assert (~clip.tissue).mean() < 0.005


@pytest.mark.parametrize("source", ["given", "none"])
def test_nothing_is_found_that_nobody_asked_for(source: str) -> None:
    clip = opened(recording("steel"), mask_source=source)
    assert clip.tissue.all()
    assert clip.masks is not None
    assert clip.masks.source == "none"


def test_a_frame_is_masked_by_itself() -> None:
    drawn = recording("steel")
    pairs = [(left.copy(), right.copy()) for left, right in drawn.clip.pairs()]
    held_out = 1
    pairs[held_out] = pairs[-1]
    spoilt = replace(drawn, clip=replace(drawn.clip, pairs=lambda: iter(pairs)))
    others = [i for i in range(FRAMES) if i != held_out]
    assert (opened(spoilt).tissue[others] == opened_alone("steel").tissue[others]).all()


def test_found_masks_are_kept(tmp_path) -> None:  # type: ignore[no-untyped-def]
    clip = opened_alone("steel")
    save_clip(tmp_path, clip, "this")
    kept = load_clip(tmp_path, "this")
    assert kept is not None
    assert (kept.tissue == clip.tissue).all()
    assert kept.masks == clip.masks


def test_a_clip_with_depth_has_its_instruments_found() -> None:
    phantom = make_phantom(PhantomSettings(width=320, height=256, frames=3, seed=3, tools=("steel",)))
    exact = phantom.depth_clip()
    bare = replace(exact, tissue=np.ones_like(exact.tissue))
    clip = with_instruments_found(bare, range(3), Hooks())
    assert overlap(clip.tissue, exact.tissue) > 0.8
    assert clip.masks is not None
    assert clip.masks.source == "found"


def looked_at_with(column: slice, colour: float, nearer: float) -> FoundMask:
    """What is found in a picture of tissue in which a rectangle is `colour` grey and `nearer` times as near."""
    frame = make_phantom(PhantomSettings(width=320, height=256, frames=1, seed=5, tools=())).frame(0)
    rgb, depth_mm = frame.left.copy(), frame.depth_mm.copy()
    place = (slice(110, 126), column)
    grey = rgb[place].mean(axis=2, keepdims=True) * 0.7
    rgb[place] = (colour * grey + (1 - colour) * rgb[place]).astype(np.uint8)
    depth_mm[place] /= nearer
    picture = Looked.at(rgb)
    return find_instruments(picture, nearness_of(picture.coarse, depth_mm), TissueLook.of([frame.left]))


SHAFT, EDGE = (slice(104, 132), slice(0, 120)), (slice(132, 136), slice(8, 120))
"""Rows and columns of an instrument, and of its lower side."""


def shaft(edge_rgb: tuple[float, float, float], without_depth: int = 0) -> FoundMask:
    """What is found of a grey shaft from the left border whose lower side has the tissue's colour times edge_rgb; its
    first columns have the tissue's depth in the lower rows."""
    frame = make_phantom(PhantomSettings(width=320, height=256, frames=1, seed=5, tools=())).frame(0)
    rgb, depth_mm = frame.left.copy(), frame.depth_mm.copy()
    rgb[SHAFT] = 0.7 * rgb[SHAFT].mean(axis=2, keepdims=True)
    rgb[EDGE] = np.median(rgb[EDGE], axis=(0, 1)) * edge_rgb
    depth_mm[104:114, :120] /= 1.25
    depth_mm[114:136, without_depth:120] /= 1.25
    picture = Looked.at(rgb)
    return find_instruments(picture, nearness_of(picture.coarse, depth_mm), TissueLook.of([frame.left]))


@pytest.mark.parametrize("edge_rgb", [(0.4, 0.4, 0.4), (1.0, 1.0, 0.3)], ids=["in shade", "golden"])
def test_an_edge_as_red_as_tissue_is_masked(edge_rgb: tuple[float, float, float]) -> None:
    assert shaft(edge_rgb).tool[EDGE].mean() > 0.95
    assert not shaft((1.0, 1.0, 1.0)).tool[EDGE][2:].any()


def test_an_instrument_is_masked_up_to_the_border_where_stereo_sees_no_depth() -> None:
    assert shaft((1.0, 1.0, 1.0), without_depth=16).tool[118:132, :16].mean() > 0.95


INSIDE, FROM_BORDER = slice(120, 220), slice(0, 120)


@pytest.mark.parametrize(
    ("column", "colour", "nearer"),
    [(INSIDE, 1.0, 1.0), (FROM_BORDER, 1.0, 1.0), (INSIDE, 1.0, 1.25)],
    ids=["inside", "lies on the tissue", "inside, in front"],
)
def test_an_instrument_that_is_not_masked_is_counted_as_missed(column: slice, colour: float, nearer: float) -> None:
    found = looked_at_with(column, colour, nearer)
    assert not found.tool.any()
    assert found.missed > 3 * MAX_MISSED


def test_an_instrument_that_mirrors_the_tissue_is_masked_and_unsure() -> None:
    found = looked_at_with(FROM_BORDER, 0.5, 1.25)
    assert found.tool[114:122, 4:116].mean() > 0.9
    assert found.tool.mean() < 0.05
    assert found.clear < 0.3 * found.seen


def test_tissue_and_masked_instruments_are_not_counted_as_missed() -> None:
    assert looked_at_with(INSIDE, 0.0, 1.0).missed < 0.5 * MAX_MISSED
    found = looked_at_with(FROM_BORDER, 1.0, 1.25)
    assert found.tool.any()
    assert found.missed < 0.5 * MAX_MISSED


@pytest.mark.parametrize(
    ("clear", "missed", "codes"),
    [
        (0.1, 0.0, []),
        (0.1, 2 * MAX_MISSED, [NoticeCode.MASKS_UNSURE]),
        (0.1 - 2 * MAX_UNSURE, 0.0, [NoticeCode.MASKS_UNSURE]),
        (0.05, 2 * MAX_MISSED, [NoticeCode.MASKS_UNSURE]),
    ],
)
def test_what_was_missed_or_is_unsure_is_told(clear: float, missed: float, codes: list[NoticeCode]) -> None:
    _, _, doubts = Finder(TissueLook(0.3)).report(0.1, np.array([[0.1, clear, missed], [0.1, clear, missed]]))
    assert [each.code for each in doubts] == codes


def test_a_picture_without_colours_is_masked_nowhere_and_unsure() -> None:
    grey = np.full((256, 320, 3), 120, np.uint8)
    picture = Looked.at(grey)
    found = find_instruments(picture, np.ones(picture.coarse.shape[:2], np.float32), TissueLook.of([grey]))
    assert not found.tool.any()
    assert (found.seen, found.clear) == (1.0, 0.0)
