"""The phantom: frames with exact truth, free viewpoints and trajectories.

Symbols: T frames, H W pixels of one eye, M tracked material points.

Truth comes from the geometry, never from the picture: depth and tracks are those of the drawn mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.types import DepthClip, StereoClip
from intrasplat.intake.calibration.types import RectifiedCalibration
from intrasplat.notices import Notice, NoticeCode
from lab.phantom.camera import endoscope_pose, right_eye
from lab.phantom.fields import Image32
from lab.phantom.instrument import InstrumentMesh, instruments_at
from lab.phantom.mesh import Fragments, interpolate, rasterize_mesh
from lab.phantom.motion import Still
from lab.phantom.settings import PhantomSettings
from lab.phantom.shading import Lamp, add_noise, endoscope_lamp, metal_finish, shade, tissue_finish, to_srgb
from lab.phantom.surface import Surface, make_surface
from lab.phantom.tissue import Paint, paint_tissue

BLUR_PX = 3  # the lens blurs with a 3x3 Gaussian of this sigma
BLUR_SIGMA_PX = 0.45
FILM_DRIFT_MM = (0.05, 0.09)  # of the wet film over the tissue in one frame, so that glints crawl
LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class PhantomFrame:
    """One frame of both eyes with its truth.

    left, right          [H, W, 3] uint8 RGB, with noise if settings ask for it
    tissue, tissue_right [H, W] bool: False at every pixel that the instrument or its blur touches
    depth_mm             [H, W] float32, camera z of what the left eye sees, instrument included; 0 beyond the tissue
    hidden_depth_mm      [H, W] float32, the same without the instrument
    hidden_rgb           [H, W, 3] float32 in [0, 1], the left eye's picture without instrument and noise
    world_from_camera    [4, 4] float64 of the left eye
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    tissue: NDArray[np.bool_]
    tissue_right: NDArray[np.bool_]
    depth_mm: NDArray[np.float32]
    hidden_depth_mm: NDArray[np.float32]
    hidden_rgb: Image32
    world_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class Trajectories:
    """Material points of one frame, as without instruments, and their positions in every frame.

    pixels    [M, 2] int32, (row, column) in that frame of the left eye
    points_mm [T, M, 3] float64, world
    """

    pixels: NDArray[np.int32]
    points_mm: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DrawnStereo:
    """A stereo clip as a user gives it, without poses and with the left eye's masks or none; and what only the phantom
    knows.

    tissue, tissue_right  [T, H, W] bool, exact
    """

    clip: StereoClip
    calibration: RectifiedCalibration
    tissue: NDArray[np.bool_]
    tissue_right: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SurfacePixels:
    """The tissue that each pixel shows, as without the instrument.

    depth_mm  [H, W] float32, camera z; 0 where no tissue is modelled
    atlas_xy  [H, W, 2] float32, the material point: (x, y) on the atlas in texels; -1 where no tissue is modelled.
              A point has the same (x, y) in every frame and from every pose.
    """

    depth_mm: NDArray[np.float32]
    atlas_xy: NDArray[np.float32]


@dataclass(frozen=True)
class _EyeView:
    rgb: Image32  # noise-free, instrument included
    tissue: NDArray[np.bool_]
    depth_mm: NDArray[np.float32]
    hidden_rgb: Image32
    hidden_depth_mm: NDArray[np.float32]


@dataclass(frozen=True)
class Phantom:
    """Synthetic tissue under a stereo endoscope. Each call draws its frame again."""

    settings: PhantomSettings
    surface: Surface
    paint: Paint

    def frame(self, index: int) -> PhantomFrame:
        """Frame 0 <= index < T of both eyes."""
        self._check_frame(index)
        left, right = self._view(index, LEFT), self._view(index, RIGHT)
        return PhantomFrame(
            left=self._recorded(left.rgb, index, LEFT),
            right=self._recorded(right.rgb, index, RIGHT),
            tissue=left.tissue,
            tissue_right=right.tissue,
            depth_mm=left.depth_mm,
            hidden_depth_mm=left.hidden_depth_mm,
            hidden_rgb=left.hidden_rgb,
            world_from_camera=self.world_from_camera(index),
        )

    def render(
        self,
        frame: float,
        world_from_camera: NDArray[np.float64] | None = None,
        intrinsics: Intrinsics | None = None,
        eye_mm: NDArray[np.float64] | None = None,
    ) -> tuple[Image32, NDArray[np.float32]]:
        """The tissue without instrument and noise, from any viewpoint; best within 15 degrees of the endoscope's.

        Args:
            frame: any real number in [0, T); model time t is frame / T.
            world_from_camera: [4, 4] mm; default: the endoscope's left eye. The lamp stays in the endoscope.
            eye_mm: [3] world position from which mirrored light is seen; default: the camera's.

        Returns:
            rgb [H, W, 3] float32 in [0, 1] and depth_mm [H, W] float32, both 0 where no tissue is modelled.
        """
        pose = self.world_from_camera(frame) if world_from_camera is None else world_from_camera
        linear, fragments = self._draw_tissue(frame, pose, intrinsics or self.settings.intrinsics, eye_mm)
        return to_srgb(_through_lens(linear)), fragments.depth_mm

    def surface_pixels(self, frame: float, world_from_camera: NDArray[np.float64] | None = None) -> SurfacePixels:
        """What the pixels show at a frame from a pose [4, 4] mm (default: the left eye's), without its colours."""
        pose = self.world_from_camera(frame) if world_from_camera is None else world_from_camera
        triangles = self.surface.triangles
        fragments = rasterize_mesh(self.surface.vertices_mm(frame), triangles, pose, self.settings.intrinsics)
        places = interpolate(fragments, triangles, self.surface.atlas_xy)
        places[fragments.triangle < 0] = -1
        return SurfacePixels(fragments.depth_mm, places)

    def world_from_camera(self, frame: float) -> NDArray[np.float64]:
        """Pose [4, 4] of the endoscope's left eye, mm; the identity at frame 0."""
        return endoscope_pose(frame, self.settings)

    def world_from_right(self, frame: float) -> NDArray[np.float64]:
        """Pose [4, 4] of the endoscope's right eye, mm."""
        return right_eye(self.world_from_camera(frame), self.settings.baseline_mm)

    def trajectories(
        self, stride_px: int = 8, shown_in: int = 0, world_from_camera: NDArray[np.float64] | None = None
    ) -> Trajectories:
        """Positions, in all frames, of the material points that every stride_px-th pixel of a frame shows, from a pose
        [4, 4] mm (default: the left eye's).
        """
        pose = self.world_from_camera(shown_in) if world_from_camera is None else world_from_camera
        vertices_mm = self.surface.vertices_mm(shown_in)
        seen = rasterize_mesh(vertices_mm, self.surface.triangles, pose, self.settings.intrinsics)
        rows, columns = np.nonzero(seen.triangle >= 0)
        chosen = (rows % stride_px == stride_px // 2) & (columns % stride_px == stride_px // 2)
        rows, columns = rows[chosen], columns[chosen]
        corners = self.surface.triangles[seen.triangle[rows, columns]]
        weights = seen.weights[rows, columns].astype(np.float64)
        weights /= weights.sum(axis=1, keepdims=True)
        points = [
            np.einsum("mk,mkc->mc", weights, self.surface.vertices_mm(frame)[corners])
            for frame in range(self.settings.frames)
        ]
        return Trajectories(np.stack([rows, columns], -1).astype(np.int32), np.stack(points))

    def depth_clip(self) -> DepthClip:
        """All frames of the left eye with true depth, for training without the errors of stereo matching."""
        settings = self.settings
        views = []
        for index in range(settings.frames):
            view = self._view(index, LEFT)
            views.append((self._recorded(view.rgb, index, LEFT), view.tissue, view.depth_mm))
        rgb, tissue, depth_mm = (np.stack(layer) for layer in zip(*views, strict=True))
        drawn = f"synthetic tissue: {settings.moves}, seed {settings.seed}, true depth"
        return DepthClip(
            rgb=rgb,
            tissue=tissue,
            depth_mm=depth_mm,
            depth_confidence=np.where(depth_mm > 0, np.uint8(255), np.uint8(0)),
            intrinsics=settings.intrinsics,
            world_from_camera=np.stack([self.world_from_camera(index) for index in range(settings.frames)]),
            frame_times_s=np.arange(settings.frames) / settings.frame_rate_hz,
            assumptions=(Notice.info(NoticeCode.SYNTHETIC, drawn),),
        )

    def stereo_recording(self, *, masks: bool = True) -> DrawnStereo:
        """All frames of both eyes as a rectified stereo clip in memory, without any loss; with or without masks."""
        settings = self.settings
        frames = [self.frame(index) for index in range(settings.frames)]
        drawn = f"synthetic tissue: {settings.moves}, seed {settings.seed}, depth by stereo"
        tissue, tissue_right = (
            np.stack([getattr(frame, name) for frame in frames]) for name in ("tissue", "tissue_right")
        )
        clip = StereoClip(
            frame_count=settings.frames,
            height=settings.height,
            width=settings.width,
            pairs=lambda: ((frame.left, frame.right) for frame in frames),
            tissue=tissue if masks else None,
            frame_times_s=np.arange(settings.frames) / settings.frame_rate_hz,
            assumptions=(Notice.info(NoticeCode.SYNTHETIC, drawn),),
        )
        return DrawnStereo(clip, settings.calibration, tissue, tissue_right)

    def _view(self, index: int, eye: int) -> _EyeView:
        """One eye at a frame, with and without instrument."""
        pose = self.world_from_camera(index) if eye == LEFT else self.world_from_right(index)
        hidden, fragments = self._draw_tissue(index, pose, self.settings.intrinsics)
        hidden_rgb = to_srgb(_through_lens(hidden))
        depth_mm = fragments.depth_mm
        if not self.settings.tools:
            return _EyeView(hidden_rgb, np.ones(depth_mm.shape, np.bool_), depth_mm, hidden_rgb, depth_mm)
        shows_tool, both, nearest_mm = np.zeros(depth_mm.shape, np.bool_), hidden, depth_mm
        for tool in instruments_at(self.surface, index, self.settings):
            linear, tool_fragments = self._draw_instrument(tool, index, pose)
            covered = (nearest_mm > 0) & (nearest_mm < tool_fragments.depth_mm)
            shows = (tool_fragments.triangle >= 0) & ~covered
            both = np.where(shows[..., None], linear, both)
            nearest_mm = np.where(shows, tool_fragments.depth_mm, nearest_mm)
            shows_tool |= shows
        # the lens blurs the instrument into its neighbours, which are then not clean tissue
        touched = cv2.dilate(shows_tool.astype(np.uint8), np.ones((BLUR_PX, BLUR_PX), np.uint8)) > 0
        return _EyeView(
            rgb=np.where(touched[..., None], to_srgb(_through_lens(both)), hidden_rgb),
            tissue=~touched,
            depth_mm=nearest_mm,
            hidden_rgb=hidden_rgb,
            hidden_depth_mm=depth_mm,
        )

    def _draw_tissue(
        self,
        frame: float,
        pose: NDArray[np.float64],
        intrinsics: Intrinsics,
        eye_mm: NDArray[np.float64] | None = None,
    ) -> tuple[Image32, Fragments]:
        vertices, normals = self.surface.vertices_and_normals(frame)
        triangles = self.surface.triangles
        fragments = rasterize_mesh(vertices, triangles, pose, intrinsics)
        attributes = np.concatenate([vertices.astype(np.float32), normals, self.surface.atlas_xy], axis=1)
        pixels = interpolate(fragments, triangles, attributes)
        atlas_x, atlas_y = np.ascontiguousarray(pixels[..., 6]), np.ascontiguousarray(pixels[..., 7])
        albedo = cv2.remap(self.paint.albedo, atlas_x, atlas_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        drift = np.zeros(2) if isinstance(self.surface.motion, Still) else np.array(FILM_DRIFT_MM) * frame
        drift = (drift / self.surface.atlas.texel_mm).astype(np.float32)
        film = cv2.remap(
            self.paint.film, atlas_x + drift[0], atlas_y + drift[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        hit = fragments.triangle >= 0
        normals = pixels[..., 3:6][hit]
        normals[:, :2] += film[..., :2][hit]  # the sheet's right and down are nearly the world's
        lit = np.zeros((*hit.shape, 3), dtype=np.float32)
        lit[hit] = shade(
            pixels[..., :3][hit],
            normals,
            albedo[hit],
            film[..., 2][hit],
            tissue_finish(),
            self._lamp(frame),
            pose[:3, 3] if eye_mm is None else eye_mm,
        )
        return lit, fragments

    def _draw_instrument(
        self, tool: InstrumentMesh, frame: float, pose: NDArray[np.float64]
    ) -> tuple[Image32, Fragments]:
        fragments = rasterize_mesh(tool.vertices_mm, tool.triangles, pose, self.settings.intrinsics)
        attributes = [tool.vertices_mm.astype(np.float32), tool.normals, tool.albedo, tool.glint[:, None]]
        pixels = interpolate(fragments, tool.triangles, np.concatenate(attributes, axis=1))
        hit = fragments.triangle >= 0
        shown = pixels[hit]
        points_mm, normals, albedo, glint = shown[:, :3], shown[:, 3:6], shown[:, 6:9], shown[:, 9]
        lit = np.zeros((*hit.shape, 3), dtype=np.float32)
        lit[hit] = shade(points_mm, normals, albedo, glint, metal_finish(), self._lamp(frame), pose[:3, 3])
        return lit, fragments

    def _lamp(self, frame: float) -> Lamp:
        return endoscope_lamp(self.world_from_camera(frame), self.settings.baseline_mm)

    def _recorded(self, rgb: Image32, index: int, eye: int) -> NDArray[np.uint8]:
        if self.settings.noise:
            rgb = add_noise(rgb, np.random.default_rng((self.settings.seed, index, eye)))
        return np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), dtype=np.uint8)

    def _check_frame(self, index: int) -> None:
        if not 0 <= index < self.settings.frames:
            raise IndexError(f"frame {index} of a clip of {self.settings.frames}")


def make_phantom(settings: PhantomSettings) -> Phantom:
    """A phantom with the settings' shape, colours and motion; it draws frames on demand."""
    shape_rng, paint_rng = (np.random.default_rng((settings.seed, part)) for part in (101, 102))
    surface = make_surface(settings, shape_rng)
    return Phantom(settings, surface, paint_tissue(surface, paint_rng))


def _through_lens(linear: Image32) -> Image32:
    return np.asarray(cv2.GaussianBlur(linear, (BLUR_PX, BLUR_PX), BLUR_SIGMA_PX), dtype=np.float32)
