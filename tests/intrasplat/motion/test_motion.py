"""Tracks follow the tissue: true trajectories of synthetic clips, nothing where nothing moves, bridges over gaps."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import unproject
from intrasplat.clip import DepthClip
from intrasplat.errors import Cancelled
from intrasplat.motion.complete import complete_depth
from intrasplat.motion.lifted import cell_means
from intrasplat.motion.tracks import GUESSED, Tracks, fit_tracks, track
from intrasplat.splat.deformation import SharedBasis
from lab.phantom import Motion, PhantomSettings, Trajectories, make_phantom
from tests.helpers import assert_close

WIDTH, HEIGHT, FRAMES = 160, 128, 24
HELD_OUT = range(1, FRAMES, 8)
TRAIN = [index for index in range(FRAMES) if index not in HELD_OUT]
TRUSTED = 0.5


@cache
def phantom(motion: Motion, *, moving_camera: bool = False, noise: bool = True) -> tuple[DepthClip, Trajectories]:
    """A clip and where its points go. Callers share the arrays: copy before you write."""
    settings = PhantomSettings(
        width=WIDTH, height=HEIGHT, frames=FRAMES, motion=motion, camera=("swing",) * moving_camera, noise=noise
    )
    made = make_phantom(settings)
    return made.depth_clip(), made.trajectories(stride_px=4)


@cache
def tracks_of(motion: Motion, *, moving_camera: bool = False) -> Tracks:
    """What is followed on the phantom's training frames, shared likewise."""
    return track(phantom(motion, moving_camera=moving_camera)[0], TRAIN)


def copied(clip: DepthClip) -> DepthClip:
    """With pictures of its own, to be written."""
    layers = ("rgb", "tissue", "depth_mm", "depth_confidence")
    return dataclasses.replace(clip, **{layer: getattr(clip, layer).copy() for layer in layers})


def on_tissue(clip: DepthClip, truth: Trajectories) -> NDArray[np.bool_]:
    """[M] whether the point shows in frame 0, not hidden by the instrument."""
    rows, columns = truth.pixels.T
    return np.asarray(clip.tissue[0, rows, columns])


def basis_of(clip: DepthClip, bases: int) -> NDArray[np.float64]:
    """[T, B]"""
    shared = SharedBasis.initial(1, bases=bases, times=[float(clip.t[i]) for i in TRAIN])
    return np.stack([shared.basis(float(t)).double().numpy() for t in clip.t])


def bare(displacement_mm: NDArray[np.floating], confidence: NDArray[np.floating]) -> Tracks:
    """Tracks of one row of pixels: displacement [K, N, 3], confidence [K, N]."""
    displacement = displacement_mm[:, None].astype(np.float32)
    return Tracks(displacement, np.zeros_like(displacement), confidence[:, None].astype(np.float32), 1)


@pytest.mark.parametrize(
    ("motion", "moving_camera"), [("breathing", False), ("pull", False), ("breathing", True), ("still", True)]
)
def test_trusted_tracks_follow_the_true_points(motion: Motion, moving_camera: bool) -> None:
    clip, truth = phantom(motion, moving_camera=moving_camera)
    tracks = tracks_of(motion, moving_camera=moving_camera)
    assert tracks.step_px == 1
    rows, columns = truth.pixels.T
    moved = truth.points_mm[TRAIN] - truth.points_mm[0]
    trusted = (tracks.confidence[:, rows, columns] > TRUSTED) & on_tissue(clip, truth)
    error_mm = np.linalg.norm(tracks.displacement_mm[:, rows, columns] - moved, axis=-1)
    assert trusted.mean() > 0.5
    assert np.median(error_mm[trusted]) < 0.5
    if motion != "still":
        assert np.linalg.norm(moved, axis=-1)[trusted].max() > 3  # mm: there was something to follow


@pytest.mark.parametrize("motion", ["breathing", "pull"])
def test_fitted_tracks_also_hold_at_frames_they_never_saw(motion: Motion) -> None:
    clip, truth = phantom(motion)
    basis = basis_of(clip, 9)
    pixels = cast(NDArray[np.intp], truth.pixels[:, 0] * WIDTH + truth.pixels[:, 1])
    weights, support = fit_tracks(tracks_of(motion), basis[TRAIN], pixels, WIDTH)
    fitted = np.einsum("tb,nbc->tnc", basis, weights[..., :3])
    moved = truth.points_mm - truth.points_mm[0]
    # where the instrument never passes and the flow never fails
    followed = (support > TRUSTED) & on_tissue(clip, truth)
    error_mm = np.linalg.norm(fitted - moved, axis=-1)[:, followed]
    assert followed.mean() > 0.4
    assert np.median(error_mm[TRAIN]) < 0.5
    assert np.median(error_mm[list(HELD_OUT)]) < 0.5


def test_held_out_frames_are_never_looked_at() -> None:
    clip, expected = copied(phantom("breathing")[0]), tracks_of("breathing")
    for layer in (clip.rgb, clip.tissue, clip.depth_mm, clip.depth_confidence):
        layer[list(HELD_OUT)] = 0
    found = track(clip, TRAIN)
    np.testing.assert_array_equal(found.displacement_mm, expected.displacement_mm)
    np.testing.assert_array_equal(found.confidence, expected.confidence)
    np.testing.assert_array_equal(found.colour, expected.colour)


def test_a_still_clip_does_not_move() -> None:
    tracks = tracks_of("still")
    length_mm = np.linalg.norm(tracks.displacement_mm, axis=-1)
    assert np.median(length_mm[tracks.confidence > TRUSTED]) < 0.05
    assert np.quantile(length_mm[tracks.confidence > TRUSTED], 0.99) < 0.5


def test_nothing_is_trusted_under_the_instrument_or_without_depth() -> None:
    clip = copied(phantom("breathing")[0])
    clip.depth_mm[:, :32] = 0
    tracks = track(clip, TRAIN)
    assert not tracks.confidence[:, :32].any()
    assert not tracks.confidence[:, ~clip.tissue[0]].any()
    assert np.isfinite(tracks.displacement_mm).all()
    assert tracks.confidence.min() >= 0
    assert tracks.confidence.max() <= 1


@pytest.mark.parametrize(("width", "step"), [(320, 1), (321, 2), (641, 3)])
def test_a_large_clip_is_followed_on_a_coarser_grid(width: int, step: int) -> None:
    height = width // 4 + 1
    clip = make_phantom(PhantomSettings(width=width, height=height, frames=3, motion="breathing")).depth_clip()
    tracks = track(clip, [0, 2])
    assert tracks.step_px == step
    assert tracks.confidence.shape == (2, height // step, width // step)
    every_pixel = np.arange(width * height)
    weights, support = fit_tracks(tracks, np.eye(2), every_pixel, width)
    assert weights.shape == (width * height, 2, 6)
    assert support[0] == pytest.approx(tracks.confidence[:, 0, 0].mean())
    assert support[-1] == pytest.approx(tracks.confidence[:, -1, -1].mean())


@pytest.mark.parametrize(("size", "step"), [((641, 130), 3), ((854, 481), 3), ((1919, 1079), 6), ((97, 80), 1)])
def test_a_cells_mean_is_that_of_its_own_pixels_at_every_size(size: tuple[int, int], step: int) -> None:
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float32)
    shape = (size[1] // step, size[0] // step)
    for ramp, axis in ((rows, 0), (columns, 1)):
        expected = np.indices(shape)[axis] * step + (step - 1) / 2
        assert_close(cell_means(ramp, step), expected)


def test_colour_and_depth_are_of_the_same_pixels_at_the_far_edge() -> None:
    clip = make_phantom(PhantomSettings(width=641, height=161, frames=2, motion="still", noise=False)).depth_clip()
    lit = np.zeros(clip.tissue.shape[1:], np.bool_)
    lit[99:129, 600:630] = True  # whole cells: there alone is depth, and there alone the light changes
    clip.rgb[0], clip.rgb[1] = 100, np.where(lit[..., None], 120, 100)
    clip.depth_mm[:, ~lit] = 0
    clip.tissue[:] = True
    tracks = track(clip, [0, 1])
    trusted = tracks.confidence[1] > TRUSTED
    assert tracks.step_px == 3
    assert trusted.sum() == 100
    assert (255 * tracks.colour[1][trusted]).min() > 19


def test_progress_grows_to_one_with_the_last_frame() -> None:
    clip, _ = phantom("still")
    shares: list[float] = []
    track(clip, TRAIN, shares.append)
    assert shares == pytest.approx([done / (len(TRAIN) - 1) for done in range(1, len(TRAIN))])


@pytest.mark.parametrize("threads", [1, 7])
def test_tracks_are_the_same_bits_on_any_number_of_cores(threads: int) -> None:
    clip, _ = phantom("pull")
    expected, found = track(clip, TRAIN, threads=2), track(clip, TRAIN, threads=threads)
    for field in dataclasses.fields(expected):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


@pytest.mark.parametrize("threads", [1, 7])
def test_what_progress_raises_ends_the_work(threads: int) -> None:
    clip, _ = phantom("still")

    def stop(share: float) -> None:
        if share > 0.2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        track(clip, TRAIN, stop, threads=threads)


def test_light_that_fades_is_told_from_motion() -> None:
    clip, _ = phantom("still")
    fading = np.linspace(1.0, 0.8, clip.frame_count)[:, None, None, None]
    dimmed = dataclasses.replace(clip, rgb=(clip.rgb * fading).astype(np.uint8))
    tracks = track(dimmed, TRAIN)
    trusted = tracks.confidence[-1] > TRUSTED
    expected = clip.rgb[0] / 255.0 * (fading[TRAIN[-1]] - 1)
    assert trusted.mean() > 0.5
    assert np.median(np.abs(tracks.colour[-1] - expected)[trusted]) < 0.01
    assert np.median(np.linalg.norm(tracks.displacement_mm[-1], axis=-1)[trusted]) < 0.1


def test_what_is_never_seen_moves_like_what_surrounds_it() -> None:
    clip, truth = phantom("breathing")
    tracks = tracks_of("breathing")
    rows, columns = truth.pixels.T
    hidden = ~on_tissue(clip, truth)
    moved_mm = (truth.points_mm[TRAIN] - truth.points_mm[0])[:, hidden]
    off_mm = np.linalg.norm(tracks.displacement_mm[:, rows, columns][:, hidden] - moved_mm, axis=-1)
    assert hidden.mean() > 0.03
    assert not tracks.confidence[:, rows, columns][:, hidden].any()
    assert np.linalg.norm(moved_mm, axis=-1).max() > 3
    assert np.median(off_mm) < 0.2 * np.median(np.linalg.norm(moved_mm, axis=-1))


def test_what_hides_for_a_while_stays_on_the_surface_around_it() -> None:
    """A wall at 60 mm; left of an instrument it comes 20 mm nearer, right of it it rests."""
    clip = copied(phantom("still", noise=False)[0])
    clip.depth_mm[:] = 60.0
    columns = np.arange(WIDTH)
    comes_mm = np.float32(20) * (columns < 60)
    instrument = (columns >= 60) & (columns < 100)
    for index in TRAIN[1:]:
        clip.depth_mm[index] = 60.0 - comes_mm * index / FRAMES
        clip.tissue[index] = ~instrument
    clip.tissue[0] = True
    last = TRAIN[-1]
    tracks = track(clip, TRAIN)
    assert not tracks.confidence[-1][:, 70:90].any()
    hidden = np.flatnonzero(instrument[None] & (np.abs(np.arange(HEIGHT) - HEIGHT / 2) < 40)[:, None])
    starts_mm = unproject(hidden, clip.depth_mm[0].ravel()[hidden], clip.intrinsics, clip.world_from_camera[0])
    ends_mm = starts_mm + tracks.displacement_mm[-1].reshape(-1, 3)[hidden]
    surface_mm = complete_depth(clip.depth_mm[last], clip.tissue[last], np.ones_like(clip.tissue[last]))
    k = clip.intrinsics
    column, row = (
        (focal * ends_mm[:, axis] / ends_mm[:, 2] + centre).astype(int)
        for axis, focal, centre in ((0, k.fx, k.cx), (1, k.fy, k.cy))
    )
    above_mm = surface_mm[row, column] - ends_mm[:, 2]
    assert np.percentile(np.abs(above_mm), 95) < 1.0


def test_a_guess_fills_what_no_frame_knows_and_hardly_bends_what_is_known(rng: np.random.Generator) -> None:
    times = np.linspace(0, 1, 40, endpoint=False)
    shared = SharedBasis.initial(1, bases=9)
    basis = np.stack([shared.basis(float(t)).double().numpy() for t in times])
    drift = np.zeros((40, 2, 3))
    drift[:, :, 0] = 8 * times[:, None]
    drift[:, 1, 1] = rng.normal(0, 1, 40)  # the second is known, and some of what it does nobody guesses
    confidence = np.stack([np.zeros(40), np.ones(40)], axis=1)
    guessed, support = fit_tracks(bare(drift, confidence), basis, np.arange(2), 2, guessed=GUESSED)
    known, _ = fit_tracks(bare(drift, confidence), basis, np.arange(2), 2)
    assert np.abs(basis @ guessed[0, :, 0] - 8 * times).max() < 0.8
    np.testing.assert_array_equal(guessed[1], known[1])
    assert support.tolist() == [0.0, 1.0]


def test_a_frame_in_which_nothing_is_trusted_is_no_evidence_of_rest() -> None:
    times = np.linspace(0, 1, 40, endpoint=False)
    shared = SharedBasis.initial(1, bases=9)
    basis = np.stack([shared.basis(float(t)).double().numpy() for t in times])
    drift, confidence = np.zeros((40, 2, 3)), np.ones((40, 2))
    drift[:, :, 0] = 8 * times[:, None]
    drift[12:26], confidence[12:26] = 0, 0  # as frames without depth are followed
    found, _ = fit_tracks(bare(drift, confidence), basis, np.arange(2), 2, guessed=GUESSED)
    assert np.abs(basis @ found[0, :, 0] - 8 * times).max() < 0.1


def test_tracks_nobody_trusts_move_nothing(rng: np.random.Generator) -> None:
    basis = rng.random((6, 4))
    weights, support = fit_tracks(bare(rng.normal(0, 5, (6, 3, 3)), np.zeros((6, 3))), basis, np.arange(3), 3)
    assert_close(weights, np.zeros((3, 4, 6)))
    assert not support.any()


def test_motion_the_bases_can_show_is_found_again(rng: np.random.Generator) -> None:
    times = np.linspace(0, 1, 40, endpoint=False)
    shared = SharedBasis.initial(1, bases=5)
    basis = np.stack([shared.basis(float(t)).double().numpy() for t in times])
    steady = np.linspace(0, 4, 5)[:, None, None] * rng.normal(0, 1, (1, 7, 3))  # [B, N, 3], drifts evenly
    displacement = np.einsum("kb,bnc->knc", basis, steady)
    weights, _ = fit_tracks(bare(displacement, np.ones((40, 7))), basis, np.arange(7), 7)
    fitted = np.einsum("kb,nbc->knc", basis, weights[..., :3])
    assert_close(fitted, displacement, relative=0.02)


def test_points_of_one_square_share_the_fit_of_its_first_pixel(rng: np.random.Generator) -> None:
    displacement, confidence = rng.normal(0, 1, (9, 6, 3)), rng.random((9, 6))
    basis, pixels = rng.random((9, 3)), np.array([5, 0, 1, 3])
    alone, _ = fit_tracks(bare(displacement, confidence), basis, np.array([3, 0, 0, 3]), 6)
    shared, _ = fit_tracks(bare(displacement, confidence), basis, pixels, 6, share_px=3)
    np.testing.assert_array_equal(shared, alone)


def test_a_gap_of_untrusted_frames_is_bridged() -> None:
    times = np.linspace(0, 1, 40, endpoint=False)
    shared = SharedBasis.initial(1, bases=9)
    basis = np.stack([shared.basis(float(t)).double().numpy() for t in times])
    drift = np.zeros((40, 1, 3))
    drift[:, 0, 0] = 8 * times
    hidden = (times > 0.3) & (times < 0.6)
    drift[hidden] = 500.0  # what a lost track may say
    weights, support = fit_tracks(bare(drift, np.where(hidden, 0.0, 1.0)[:, None]), basis, np.arange(1), 1)
    fitted = basis @ weights[0, :, 0]
    assert np.abs(fitted - 8 * times)[hidden].max() < 1.0
    assert support[0] == pytest.approx(1 - hidden.mean())
