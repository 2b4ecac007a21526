"""What only synthetic clips can tell: other poses, what the instrument hides, true depth, motion in 3D.

Symbols: T frames, H W pixels, M material points of frame 0.

Whatever is judged is a Candidate: a scene, or the phantom itself, which scores as well as anything can.

view   a held-out frame's moment from a pose 10 or 15 degrees off the endoscope's, to the right, up, left or down, about
       the point at the clip's median depth on its axis (intrasplat/pose.py). Judged are the pixels whose material
       point some training frame showed as tissue. Wet tissue mirrors the lamp, elsewhere for every eye: a clip from one
       place cannot tell where. So three figures: the view as it is; `baked`, the view with its highlights where the
       endoscope sees them; and the bound, what that baked view itself scores as the view. No model whose colours do not
       depend on the viewpoint passes the bound but by chance.
        A stereo clip has two eyes that show tissue, whichever of them is trained on.
hidden the endoscope's own picture of a held-out frame behind the instrument, on the same condition.
depth  median |z - truth| over tissue of held-out frames.
empty_ok  share of all pixels of those views in which nothing solid is drawn where truth is empty: nothing nearer than
       the nearest true surface within one pixel by more than FREE_SPACE of its depth, and nothing at all where no pixel
       within one shows tissue. A pixel that the render marks as unseen is not solid.
seen_ok   share of the judged pixels of those views in which something solid is drawn.
rank   Spearman's rank correlation of the confidence layer with the smallness of a pixel's error (ranking.py), over all
       pixels that show tissue, seen or not, in those views: rank_colour, rank_depth; and in the right eye's own
       views of the same frames: rank_right_colour, rank_right_depth. Those that end in _8px are of squares of 8 pixels.
motion of what a pixel of frame 0 shows: the displacements of the Gaussians it is blended of, each from its own centre
       at frame 0 to that at frame i, blended with the same weights. Gaussians a pixel hardly shows hardly count, and
       none has to be declared the nearest. The end-point error is its distance to the true displacement of the
       material point that the pixel shows; the median over tissue pixels of frame 0 and held-out frames, and over
       those alone that have moved by MOVING_MM or more. In a pull most tissue rests: a model without any motion has a
       small median, but over what moves it scores the median displacement itself, moving_mm.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.metrics import COVERED_ALPHA, depth_agreement_mm, depth_errors_mm, psnr_tissue
from intrasplat.train.scoring import sample_frames
from intrasplat.view.camera import view_camera
from intrasplat.view.render import render_frame
from lab.evaluate.ranking import PixelErrors, pixel_errors, rank_scores, together
from lab.evaluate.thinned import lattice
from lab.phantom import Phantom

Pose = NDArray[np.float64]

ANGLES_DEG = (10.0, 15.0)
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Directions (yaw, pitch) of the views; they alternate from frame to frame."""
JUDGED_FRAMES = 8
"""Held-out frames looked at, evenly spread."""
TRACK_STRIDE_PX = 4
MOVING_MM = 1.0
"""A point that has moved less counts as resting; stereo noise is a few tenths of a mm."""
SEEN_CELL_TEXELS = 4
"""A material point counts as seen if training frames showed some in the same square of the tissue's texture, about
three pixels wide, and in all squares about it."""
FREE_SPACE = 0.03
"""A rendered surface that is nearer than the true one by more than this share of its depth lies in free space."""


@dataclass(frozen=True, eq=False)
class ShownView:
    """A candidate's render: rgb [H, W, 3] float in [0, 1], depth_mm [H, W], 0 where it draws nothing solid, and
    confidence [H, W] in [0, 1].
    """

    rgb: NDArray[np.float32]
    depth_mm: NDArray[np.float32]
    confidence: NDArray[np.float32]


class Candidate(Protocol):
    """A model that can be scored against the truth."""

    def view(self, frame: int, pose: Pose) -> ShownView:
        """The tissue at a frame from world_from_camera [4, 4] in mm, with the clip's intrinsics."""
        ...

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        """[H, W, 3] mm, world: displacement up to `frame` of what each pixel of frame 0 shows; NaN where unknown."""
        ...


@dataclass(frozen=True)
class TruthScores:
    """NaN where there was nothing to judge; dB are means over the judged frames, mm medians, the rest shares and rank
    correlations over all pixels of all judged frames (see above)."""

    psnr_view10_db: float
    psnr_view15_db: float
    psnr_baked10_db: float
    psnr_baked15_db: float
    bound10_db: float
    bound15_db: float
    psnr_hidden_db: float
    depth_error_mm: float
    motion_error_mm: float
    moving_error_mm: float
    moving_mm: float
    empty_ok: float
    seen_ok: float
    rank_colour: float
    rank_depth: float
    rank_colour_8px: float
    rank_depth_8px: float
    rank_right_colour: float
    rank_right_depth: float
    rank_right_colour_8px: float
    rank_right_depth_8px: float


@dataclass(frozen=True, eq=False)
class Expected:
    """A picture, the same with mirrored light as the endoscope sees it, the pixels both are judged on, depth, and
    clear_mm, up to which nothing solid may be drawn; all of the lattice's pixels alone."""

    frame: int
    pose: Pose
    rgb: NDArray[np.float32]
    baked: NDArray[np.float32]
    judged: NDArray[np.bool_]
    depth_mm: NDArray[np.float32]
    clear_mm: NDArray[np.float32]


class Truth:
    """The truth of a phantom for one split of its frames, drawn once and compared with many scenes."""

    def __init__(
        self,
        phantom: Phantom,
        tissue: NDArray[np.bool_],
        train: Sequence[int],
        held_out: Sequence[int],
        tissue_right: NDArray[np.bool_] | None = None,
        step_px: int = 1,
        angles_deg: Sequence[float] = ANGLES_DEG,
    ) -> None:
        """tissue [T, H, W]: exact, of the left eye; tissue_right: of a stereo clip's right eye, which shows it too.

        step_px: candidates draw, and are judged on, that lattice of pixels alone (lab/evaluate/thinned.py).
        angles_deg: of the views beside the endoscope; score() needs ANGLES_DEG.
        """
        self._phantom, self._lattice = phantom, lattice(step_px)
        self._tissue, self._tissue_of_tracks = tissue[(slice(None), *self._lattice)], tissue[0]
        self._judged_frames = sample_frames(held_out, JUDGED_FRAMES)
        self._seen, pivot_mm = _seen_by(phantom, train, tissue, tissue_right)
        self._tracks = phantom.trajectories(TRACK_STRIDE_PX)
        self._views = {angle: list(self._off_axis(angle, pivot_mm)) for angle in angles_deg}
        self._own = [self._expected(frame, phantom.world_from_camera(frame)) for frame in self._judged_frames]
        self._right = [self._expected(frame, phantom.world_from_right(frame)) for frame in self._judged_frames]
        self._bounds_db = [_mean_psnr([each.baked for each in views], views) for views in self._views.values()]

    def score(self, candidate: Candidate) -> TruthScores:
        """Score the candidate against the truth."""
        at10, at15 = (self._shown(candidate, views) for views in self._views.values())
        views10, views15 = self._views.values()
        shown, expected = at10 + at15, views10 + views15
        own = self._shown(candidate, self._own)
        error_mm, moving_error_mm, moving_mm = self._motion(candidate)
        return TruthScores(
            psnr_view10_db=_mean_psnr(_pictures(at10), views10),
            psnr_view15_db=_mean_psnr(_pictures(at15), views15),
            psnr_baked10_db=_mean_psnr(_pictures(at10), views10, "baked"),
            psnr_baked15_db=_mean_psnr(_pictures(at15), views15, "baked"),
            bound10_db=self._bounds_db[0],
            bound15_db=self._bounds_db[1],
            psnr_hidden_db=_mean_psnr(_pictures(own), self.hidden),
            depth_error_mm=self._depth(own),
            motion_error_mm=error_mm,
            moving_error_mm=moving_error_mm,
            moving_mm=moving_mm,
            empty_ok=float(np.mean([_is_clear(*pair) for pair in zip(shown, expected, strict=True)])),
            seen_ok=_share_solid(shown, expected),
            **rank_scores(errors_of(shown, expected), "rank"),
            **rank_scores(self._right_errors(candidate), "rank_right"),
        )

    @property
    def off_axis(self) -> dict[float, list[Expected]]:
        """The views by their angle in degrees."""
        return self._views

    @property
    def hidden(self) -> list[Expected]:
        """The left eye's views, judged where an instrument hides tissue."""
        return [self._behind_instrument(each) for each in self._own]

    @property
    def expected(self) -> dict[str, list[Expected]]:
        """The views `off-axis`, and those of the `right` eye."""
        return {"off-axis": [each for views in self._views.values() for each in views], "right": self._right}

    def _right_errors(self, candidate: Candidate) -> PixelErrors:
        return errors_of(self._shown(candidate, self._right), self._right)

    def _shown(self, candidate: Candidate, expected: Sequence[Expected]) -> list[ShownView]:
        return [candidate.view(each.frame, each.pose) for each in expected]

    def _off_axis(self, angle_deg: float, pivot_mm: float) -> Iterable[Expected]:
        for place, frame in enumerate(self._judged_frames):
            yaw, pitch = DIRECTIONS[place % len(DIRECTIONS)]
            orbit = OrbitPose(yaw_deg=yaw * angle_deg, pitch_deg=pitch * angle_deg, zoom=1.0)
            about = np.array(world_from_camera(orbit, pivot_mm), np.float64)
            yield self._expected(frame, self._phantom.world_from_camera(frame) @ about)

    def _expected(self, frame: int, pose: Pose) -> Expected:
        rgb, depth_mm = self._phantom.render(frame, pose)
        eye_mm = self._phantom.world_from_camera(frame)[:3, 3]
        baked = rgb if np.array_equal(pose[:3, 3], eye_mm) else self._phantom.render(frame, pose, eye_mm=eye_mm)[0]
        row, column, shows = _cells(self._phantom.surface_pixels(frame, pose).atlas_xy)
        judged, clear_mm, at = shows & self._seen[row, column], _clear_mm(depth_mm), self._lattice
        return Expected(frame, pose, rgb[at], baked[at], judged[at], depth_mm[at], clear_mm[at])

    def _behind_instrument(self, own: Expected) -> Expected:
        return replace(own, judged=own.judged & ~self._tissue[own.frame])

    def _depth(self, own: Sequence[ShownView]) -> float:
        errors = [
            depth_errors_mm(view.depth_mm, each.depth_mm, self._tissue[each.frame])
            for view, each in zip(own, self._own, strict=True)
        ]
        return depth_agreement_mm(errors)

    def _motion(self, candidate: Candidate) -> tuple[float, float, float]:
        """Medians in mm: end-point error of all points, of moving points, and the displacement of moving points."""
        row, column = self._tracks.pixels.T
        tissue = self._tissue_of_tracks[row, column]
        row, column, points_mm = row[tissue], column[tissue], self._tracks.points_mm[:, tissue]
        errors, moves = [np.empty(0)], [np.empty(0)]
        for frame in self._judged_frames:
            truth_mm = points_mm[frame] - points_mm[0]
            distance = np.linalg.norm(candidate.motion_mm(frame)[row, column] - truth_mm, axis=1)
            shows = np.isfinite(distance)
            errors.append(distance[shows])
            moves.append(np.linalg.norm(truth_mm[shows], axis=1))
        error_mm, moved_mm = np.concatenate(errors), np.concatenate(moves)
        moving = moved_mm >= MOVING_MM
        return _median(error_mm), _median(error_mm[moving]), _median(moved_mm[moving])


class SceneCandidate:
    """A stored scene as a Candidate."""

    def __init__(self, scene: TrainedScene) -> None:
        self._scene, self._model = scene, model_of(scene)

    def view(self, frame: int, pose: Pose) -> ShownView:
        shown = render_frame(self._scene, frame / self._scene.frame_count, pose)
        rgb, is_shown = self._image(frame, pose)[:3].transpose(1, 2, 0), ~shown.unseen
        return ShownView(rgb, shown.depth_mm * is_shown, shown.confidence * is_shown)

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        start, end = (self._model.deformed_mean(each / self._scene.frame_count) for each in (0, frame))
        moved_mm = (end - start) / np.float32(self._scene.units_per_mm)
        image = self._model.blended(self._camera(0, self._scene.world_from_camera[0]), 0.0, moved_mm)
        blended, alpha = image[:3].transpose(1, 2, 0), image[4, ..., None]
        return np.where(alpha >= COVERED_ALPHA, blended / np.maximum(alpha, COVERED_ALPHA), np.nan)

    def _camera(self, frame: int, pose: Pose) -> NDArray[np.float64]:
        return view_camera(self._scene, frame / self._scene.frame_count, pose, self._scene.intrinsics)

    def _image(self, frame: int, pose: Pose) -> NDArray[np.float32]:
        """R G B Z A [5, H, W], a copy."""
        return self._model.render(self._camera(frame, pose), frame / self._scene.frame_count).copy()


def _seen_by(
    phantom: Phantom,
    train: Sequence[int],
    tissue: NDArray[np.bool_],
    tissue_right: NDArray[np.bool_] | None,
    *,
    eroded: bool = True,
) -> tuple[NDArray[np.bool_], float]:
    """Which squares of the tissue's texture some training frame of an eye shows as tissue, and the left eye's median
    over training frames of the median depth of tissue, mm. eroded: only those whose neighbours show, too."""
    rows, columns = (size // SEEN_CELL_TEXELS + 1 for size in phantom.surface.atlas.shape)
    seen = np.zeros((rows, columns), np.bool_)
    medians_mm = []
    for frame in train:
        left = phantom.surface_pixels(frame)
        medians_mm.append(np.median(left.depth_mm[tissue[frame] & (left.depth_mm > 0)]))
        eyes = [(left, tissue)]
        if tissue_right is not None:
            eyes.append((phantom.surface_pixels(frame, phantom.world_from_right(frame)), tissue_right))
        for surface, shown in eyes:
            row, column, shows = _cells(surface.atlas_xy)
            visible = shows & shown[frame]
            seen[row[visible], column[visible]] = True
    # On oblique tissue, neighbouring pixels are more than a square apart: close such gaps first.
    closed = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inner = closed if not eroded else cv2.erode(closed, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(inner, np.bool_), float(np.median(medians_mm))


def seen_now(
    phantom: Phantom, view: Expected, tissue: NDArray[np.bool_], tissue_right: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """[H, W] whether an eye shows what the view's pixels show in the view's own frame; tissue [T, H, W] of each eye."""
    seen, _ = _seen_by(phantom, [view.frame], tissue, tissue_right, eroded=False)
    row, column, shows = _cells(phantom.surface_pixels(view.frame, view.pose).atlas_xy)
    return np.asarray(shows & seen[row, column])


def _clear_mm(depth_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W] up to where nothing solid may be drawn: a little before the nearest true surface within one pixel."""
    true_mm = np.where(depth_mm > 0, depth_mm, np.inf).astype(np.float32)
    nearest_mm = cv2.erode(true_mm, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(nearest_mm * (1 - FREE_SPACE), np.float32)


def _is_clear(shown: ShownView, expected: Expected) -> NDArray[np.bool_]:
    """[H, W] whether nothing solid is drawn where nothing may be."""
    return np.asarray((shown.depth_mm <= 0) | (shown.depth_mm >= expected.clear_mm), np.bool_)


def _share_solid(shown: Sequence[ShownView], expected: Sequence[Expected]) -> float:
    """Share of the judged pixels in which something solid is drawn."""
    solid = [view.depth_mm[each.judged] > 0 for view, each in zip(shown, expected, strict=True)]
    judged = np.concatenate(solid)
    return float(judged.mean()) if judged.size else math.nan


def errors_of(shown: Sequence[ShownView], expected: Sequence[Expected]) -> PixelErrors:
    """The errors of every pixel that shows tissue in the truth."""
    return together(
        [
            pixel_errors(view.confidence, (view.rgb, each.rgb), (view.depth_mm, each.depth_mm), each.depth_mm > 0)
            for view, each in zip(shown, expected, strict=True)
        ]
    )


def _pictures(shown: Sequence[ShownView]) -> list[NDArray[np.float32]]:
    return [each.rgb for each in shown]


def _cells(atlas_xy: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Row and column of each pixel's square of the texture [H, W], and whether the pixel shows any."""
    shows = atlas_xy[..., 0] >= 0
    cell = np.where(shows[..., None], np.rint(atlas_xy) // SEEN_CELL_TEXELS, 0).astype(np.intp)
    return cell[..., 1], cell[..., 0], shows


def _mean_psnr(
    pictures: Sequence[NDArray[np.float32]], expected: Sequence[Expected], against: Literal["rgb", "baked"] = "rgb"
) -> float:
    """Mean over frames of the PSNR on judged pixels, dB; NaN if no frame has any."""
    pairs = zip(pictures, expected, strict=True)
    scores = [psnr_tissue(picture, getattr(each, against), each.judged) for picture, each in pairs]
    known = [score for score in scores if not math.isnan(score)]
    return float(np.mean(known)) if known else math.nan


def _median(values: NDArray[np.floating]) -> float:
    return float(np.median(values)) if values.size else math.nan
