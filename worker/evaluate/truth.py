"""What only synthetic clips can tell: other poses, what the instrument hides, true depth, motion in 3D.

Symbols: T frames, H W pixels, M material points of frame 0.

Whatever is judged is a Candidate: a scene, or the phantom itself, which scores as well as anything can.

view   a held-out frame's moment from a pose 10 or 15 degrees off, to the right, up, left or down, about the point at
       median depth on frame 0's axis (contract/wire/pose.py). Judged are the pixels whose material point some training
       frame showed as tissue. Wet tissue mirrors the lamp, elsewhere for every eye: a clip from one place cannot tell
       where. So three figures: the view as it is; `baked`, the view with its highlights where the endoscope sees them;
       and the bound, what that baked view itself scores as the view. No model whose colours do not depend on the
       viewpoint passes the bound but by chance.
hidden the endoscope's own picture of a held-out frame behind the instrument, on the same condition.
depth  median |z - truth| over tissue of held-out frames.
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
from dataclasses import dataclass
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.pose import OrbitPose, world_from_camera
from worker.input.clip import DepthClip
from worker.model.metrics import COVERED_ALPHA, depth_agreement_mm, depth_errors_mm, psnr_tissue
from worker.phantom import Phantom
from worker.raster.step import camera_vector
from worker.scene.model import model_of
from worker.scene.scene import Scene
from worker.train.hooks import RenderedFrame
from worker.train.scoring import sample_frames
from worker.train.targets import camera_in_units, solid_depth_mm

Pose = NDArray[np.float64]

ANGLES_DEG = (10.0, 15.0)
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Yaw and pitch of the views, in turn from frame to frame."""
JUDGED_FRAMES = 8
"""Held-out frames looked at, evenly spread."""
TRACK_STRIDE_PX = 4
MOVING_MM = 1.0
"""A point that has gone less far counts as resting; stereo's own noise is a few tenths."""
SEEN_CELL_TEXELS = 4
"""A material point counts as seen if training frames showed some in the same square of the tissue's texture, about
three pixels wide, and in all squares about it."""


class Candidate(Protocol):
    """What can be judged against the truth."""

    def view(self, frame: int, pose: Pose) -> RenderedFrame:
        """The tissue at a frame from world_from_camera [4, 4] in mm, with the clip's intrinsics."""
        ...

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        """[H, W, 3] world: where what each pixel of frame 0 shows has gone at `frame`; NaN where nothing is shown."""
        ...


@dataclass(frozen=True)
class TruthScores:
    """NaN where there was nothing to judge; dB are means over the judged frames, mm medians (see above)."""

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


@dataclass(frozen=True, eq=False)
class _Expected:
    """A picture, the same with mirrored light as the endoscope sees it, and the pixels both are judged on."""

    frame: int
    pose: Pose
    rgb: NDArray[np.float32]
    baked: NDArray[np.float32]
    judged: NDArray[np.bool_]


class Truth:
    """The truth of a phantom for one split of its frames, drawn once and compared with many scenes."""

    def __init__(self, phantom: Phantom, clip: DepthClip, train: Sequence[int], held_out: Sequence[int]) -> None:
        self._phantom, self._clip = phantom, clip
        self._judged_frames = sample_frames(held_out, JUDGED_FRAMES)
        self._seen = _seen_cells(phantom, clip, train)
        self._tracks = phantom.trajectories(TRACK_STRIDE_PX)
        pivot_mm = float(
            np.median([np.median(clip.depth_mm[i][clip.tissue[i] & (clip.depth_mm[i] > 0)]) for i in train])
        )
        self._views = {angle: list(self._off_axis(angle, pivot_mm)) for angle in ANGLES_DEG}
        self._hidden = [self._behind_instrument(frame) for frame in self._judged_frames]
        self._bounds_db = [_mean_psnr([each.baked for each in views], views) for views in self._views.values()]

    def score(self, candidate: Candidate) -> TruthScores:
        """How near the candidate is to the truth."""
        views = {
            angle: [candidate.view(each.frame, each.pose).rgb for each in self._views[angle]] for angle in ANGLES_DEG
        }
        hidden = [candidate.view(each.frame, each.pose).rgb for each in self._hidden]
        at10, at15 = ((views[angle], self._views[angle]) for angle in ANGLES_DEG)
        error_mm, moving_error_mm, moving_mm = self._motion(candidate)
        return TruthScores(
            psnr_view10_db=_mean_psnr(*at10),
            psnr_view15_db=_mean_psnr(*at15),
            psnr_baked10_db=_mean_psnr(*at10, "baked"),
            psnr_baked15_db=_mean_psnr(*at15, "baked"),
            bound10_db=self._bounds_db[0],
            bound15_db=self._bounds_db[1],
            psnr_hidden_db=_mean_psnr(hidden, self._hidden),
            depth_error_mm=self._depth(candidate),
            motion_error_mm=error_mm,
            moving_error_mm=moving_error_mm,
            moving_mm=moving_mm,
        )

    def _off_axis(self, angle_deg: float, pivot_mm: float) -> Iterable[_Expected]:
        for place, frame in enumerate(self._judged_frames):
            yaw, pitch = DIRECTIONS[place % len(DIRECTIONS)]
            orbit = OrbitPose(yaw_deg=yaw * angle_deg, pitch_deg=pitch * angle_deg, zoom=1.0)
            pose = np.array(world_from_camera(orbit, pivot_mm), np.float64)
            rgb, _ = self._phantom.render(frame, pose)
            baked, _ = self._phantom.render(frame, pose, eye_mm=self._phantom.world_from_camera(frame)[:3, 3])
            yield _Expected(frame, pose, rgb, baked, self._was_seen(frame, pose))

    def _behind_instrument(self, frame: int) -> _Expected:
        pose = self._phantom.world_from_camera(frame)
        rgb, _ = self._phantom.render(frame, pose)
        return _Expected(frame, pose, rgb, rgb, self._was_seen(frame, pose) & ~self._clip.tissue[frame])

    def _was_seen(self, frame: int, pose: Pose) -> NDArray[np.bool_]:
        """[H, W] whether the material point that a pixel shows was tissue in some training frame."""
        row, column, shows = _cells(self._phantom.atlas_xy(frame, pose))
        return shows & self._seen[row, column]

    def _depth(self, candidate: Candidate) -> float:
        errors = []
        for frame in self._judged_frames:
            view = candidate.view(frame, self._phantom.world_from_camera(frame))
            errors.append(depth_errors_mm(view.depth_mm, self._clip.depth_mm[frame], self._clip.tissue[frame]))
        return depth_agreement_mm(errors)

    def _motion(self, candidate: Candidate) -> tuple[float, float, float]:
        """Medians in mm: end-point error of all, of what moves, and how far that has moved."""
        row, column = self._tracks.pixels.T
        tissue = self._clip.tissue[0][row, column]
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
    """A stored scene as it is rendered."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._model = scene, model_of(scene)

    def view(self, frame: int, pose: Pose) -> RenderedFrame:
        image = self._image(frame, pose)
        depth_mm = solid_depth_mm(image[3], image[4], self._scene.units_per_mm)
        return RenderedFrame(image[:3].transpose(1, 2, 0), depth_mm, image[4])

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        start, end = (self._model.deformed_mean(each / self._scene.frame_count) for each in (0, frame))
        alpha = self._image(0, self._scene.world_from_camera[0])[4]
        moved_mm = (end - start) / np.float32(self._scene.units_per_mm)
        blended = np.stack([self._model.blend_values(np.ascontiguousarray(axis)).copy() for axis in moved_mm], -1)
        solid = (alpha >= COVERED_ALPHA)[..., None]
        return np.where(solid, blended / np.maximum(alpha, COVERED_ALPHA)[..., None], np.nan)

    def _image(self, frame: int, pose: Pose) -> NDArray[np.float32]:
        """R G B Z A [5, H, W], a copy."""
        scene = self._scene
        camera = camera_vector(camera_in_units(scene.intrinsics, pose, scene.units_per_mm))
        return self._model.render(camera, frame / scene.frame_count).copy()


def _seen_cells(phantom: Phantom, clip: DepthClip, train: Sequence[int]) -> NDArray[np.bool_]:
    """Which squares of the tissue's texture some training frame shows as tissue."""
    rows, columns = (size // SEEN_CELL_TEXELS + 1 for size in phantom.surface.atlas.shape)
    seen = np.zeros((rows, columns), np.bool_)
    for frame in train:
        row, column, shows = _cells(phantom.atlas_xy(frame))
        visible = shows & clip.tissue[frame]
        seen[row[visible], column[visible]] = True
    # Where the tissue lies obliquely, neighbouring pixels are more than a square apart: first such gaps are closed.
    closed = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inner = cv2.erode(closed, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(inner, np.bool_)


def _cells(atlas_xy: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Row and column of each pixel's square of the texture [H, W], and whether the pixel shows any."""
    shows = atlas_xy[..., 0] >= 0
    cell = np.where(shows[..., None], np.rint(atlas_xy) // SEEN_CELL_TEXELS, 0).astype(np.intp)
    return cell[..., 1], cell[..., 0], shows


def _mean_psnr(
    pictures: Sequence[NDArray[np.float32]], expected: Sequence[_Expected], against: Literal["rgb", "baked"] = "rgb"
) -> float:
    """Mean over frames of the PSNR on judged pixels, dB; NaN if no frame has any."""
    pairs = zip(pictures, expected, strict=True)
    scores = [psnr_tissue(picture, getattr(each, against), each.judged) for picture, each in pairs]
    known = [score for score in scores if not math.isnan(score)]
    return float(np.mean(known)) if known else math.nan


def _median(values: NDArray[np.floating]) -> float:
    return float(np.median(values)) if values.size else math.nan
