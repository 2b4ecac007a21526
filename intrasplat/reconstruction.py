"""`reconstruct` turns a clip into a `Scene`, which renders, saves and exports itself; `load` reads a saved one.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.export import export_parts
from intrasplat.formats import EXPORT_FORMATS, check_export
from intrasplat.machine.hooks import Progress, ignore, never
from intrasplat.names import MANIFEST, REPORT, RESUME_STATE, Detail, Light, Smoke
from intrasplat.options import FIELD_PREFIX, ReconstructionOptions, parse_options
from intrasplat.picture import MAX_RENDER_PIXELS, IntrinsicsOverride
from intrasplat.pipeline import reconstruct as run_pipeline
from intrasplat.pose import MatrixPose, OrbitPose, parse_pose
from intrasplat.recording import Clip, FilePath
from intrasplat.report import Report
from intrasplat.scene.checkpoint import check_is_scene, load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.stored_exports import installed_dashboard, stored_parts
from intrasplat.splat.backend import choose_device
from intrasplat.stereo import ClipPaths
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.view.camera import camera_of, pose_of
from intrasplat.view.frame import View
from intrasplat.view.render import render_frame

AnyPose: TypeAlias = MatrixPose | OrbitPose | NDArray[np.floating[Any]] | str | None
"""What a caller may give as a pose."""


class Scene:
    """A reconstructed clip, to be rendered at any moment from any pose. `reconstruct` and `load` return it.

    Example:
        >>> scene.frame_count
        10
        >>> scene.report.iterations
        4
    """

    def __init__(self, folder: Path, device: str = "auto") -> None:
        """folder: contains the scene's files, as `reconstruct` and the command line write them."""
        self._folder, self._device = folder, device

    def __repr__(self) -> str:
        return f"Scene({len(self.trained.gaussians)} Gaussians, {self.frame_count} frames, {self.trained.preset})"

    @cached_property
    def trained(self) -> TrainedScene:
        """The model itself: Gaussians and deformation in optimiser units (mm * units_per_mm), camera, poses."""
        return load_scene(self._folder)

    @cached_property
    def report(self) -> Report:
        """The quality report: scores of held-out frames, assumptions and warnings.

        Raises:
            InputError: the scene has no report.
        """
        path = self._folder / REPORT
        if not path.is_file():
            raise InputError("folder", f"{self._folder} holds no {REPORT}.", "Reconstruct the clip again.")
        return Report.model_validate_json(path.read_bytes())

    @property
    def frame_count(self) -> int:
        """T, the frames of the clip; frame i is shown at t = i / T."""
        return self.trained.frame_count

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera of the clip's left eye, in pixels."""
        return self.trained.intrinsics

    @property
    def world_from_camera(self) -> NDArray[np.float64]:
        """[T, 4, 4] the endoscope's own poses in mm, OpenCV axes."""
        return self.trained.world_from_camera

    def render(
        self,
        t: float,
        pose: AnyPose = None,
        *,
        width: int | None = None,
        height: int | None = None,
        intrinsics: Intrinsics | None = None,
        highlights: bool = True,
        light: Light = "steady",
        smoke: Smoke = "remove",
        detail: Detail = "on",
    ) -> View:
        """The scene at model time t from a pose, instruments removed.

        Args:
            t: 0 is the first frame, i / T is frame i; later times show the last frame, with a warning.
            pose: `orbit(...)`, `parse_pose(...)`, [4, 4] world_from_camera in mm, or text; None: the endoscope's.
            width, height: size of the picture in pixels; one alone keeps the aspect ratio. Default: the clip's size.
            intrinsics: another camera, instead of width and height.
            highlights: whether to show the highlights that were separated by means of the two eyes of a stereo clip.
            light: "steady": where exposure or white balance change in the clip, or the border is dark, the even light
                of one frame at all times; "recorded": that in which the moment was recorded.
            smoke: "show": behind the smoke that was found before the tissue; "remove": without it.
            detail: "on": with what the model misses of the recorded frames nearest in time, if they are kept; "off":
                the model alone.

        Returns:
            A View with rgb [H, W, 3] uint8, depth_mm [H, W] float32 (0: nothing solid), confidence [H, W] float32 in
            [0, 1], unseen [H, W] bool and warnings.

        Raises:
            InputError: the pose or the size cannot be used.
            LimitError: the picture has too many pixels.
            UnavailableError: the device is missing.

        Example:
            >>> view = scene.render(t=0.4, pose=isp.orbit(10, 0))
            >>> view.rgb.shape[:2] == view.depth_mm.shape == view.confidence.shape
            True
        """
        if not np.isfinite(t):
            raise InputError("t", f"it is {t}.", "Give a number: 0 is the first frame, 1 the end of the clip.")
        camera = intrinsics or lens_of(self.trained, width, height)
        return render_frame(
            self.trained, t, world_from_camera_of(self.trained, pose), camera, choose_device(self._device),
            highlights=highlights, light=light, smoke=smoke, detail=detail,
        )  # fmt: skip

    def save(self, folder: FilePath) -> None:
        """Write the scene's files into a new or empty folder; `load` and the command line read them.

        Raises:
            InputError: the folder is not empty.

        Example:
            >>> scene.save(tmp / "scene")
            >>> isp.load(tmp / "scene").frame_count
            10
        """
        target = Path(folder)
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise InputError("folder", f"{target} is there already.", "Name a new folder, or empty it.")
        target.mkdir(parents=True, exist_ok=True)
        files = sorted(self._folder.iterdir(), key=lambda path: path.name == MANIFEST)  # the manifest completes it
        for path in files:
            if path.is_file() and path.name not in RESUME_STATE:
                shutil.copyfile(path, target / path.name)

    def export(
        self,
        path: FilePath,
        *,
        format: str | None = None,
        t: float | None = None,
        every: int | None = None,
        view: str | None = None,
        baseline_mm: float | None = None,
        recorded: str | None = None,
    ) -> Path:
        """Write the scene as a file for other programs.

        Args:
            path: the file. It is written under another name first, so that it is complete or missing.
            format: one of `intrasplat export --help` (docs/export.md); None: the first with the ending of path.
            t: model time, for formats of one moment and for view="orbit".
            every: for formats over time: use every n-th frame.
            view: for a video: endoscope, orbit or stereo.
            baseline_mm: distance between the eyes, for view="stereo".
            recorded: for a page: "on" puts in the recorded frames, which show the patient's tissue and the instruments;
                "off" leaves them out; None: in, if they are small.

        Returns:
            The path of the file.

        Raises:
            InputError: there is no such format, an option does not fit it, or the file cannot be written.
            LimitError: the file would be too large.
            UnavailableError: the format needs a package that is not installed.

        Example:
            >>> scene.export(tmp / "scene.ply", t=0.4).name
            'scene.ply'
        """
        target = Path(path)
        name = format or next((each for each, one in EXPORT_FORMATS.items() if target.name.endswith(one.suffix)), None)
        if name is None:
            endings = ", ".join(dict.fromkeys(each.suffix for each in EXPORT_FORMATS.values()))
            raise InputError("path", f"{target.name!r} has no known ending.", f"Use {endings}, or name a format.")
        given = {"t": t, "every": every, "view": view, "baseline_mm": baseline_mm, "recorded": recorded}
        chosen = check_export(name, given)
        if EXPORT_FORMATS[name].is_stored:
            parts = stored_parts(name, self._folder, None, installed_dashboard(), recorded=chosen.recorded)
        else:
            parts = export_parts(self.trained, name, chosen, choose_device(self._device))
        unfinished = target.with_name(f".{target.name}.part")
        try:
            with unfinished.open("wb") as file:
                for part in parts:
                    file.write(part)
            unfinished.replace(target)
        except OSError as error:
            raise InputError("path", f"{target} cannot be written ({error.strerror}).", "Name another file.") from error
        finally:
            unfinished.unlink(missing_ok=True)
        return target


def lens_of(scene: TrainedScene, width: int | None, height: int | None) -> Intrinsics:
    """The scene's camera with these pixels; raises as Scene.render."""
    try:
        wanted = IntrinsicsOverride(width=width, height=height)
    except ValidationError as error:
        first = error.errors()[0]
        field, problem = str(first["loc"][0]), f"{first['input']} is not accepted: {first['msg']}."
        raise InputError(field, problem, "Give 8 to 8192 pixels.") from error
    return camera_of(scene.intrinsics, wanted, MAX_RENDER_PIXELS)


def world_from_camera_of(scene: TrainedScene, pose: AnyPose) -> NDArray[np.float64] | None:
    """[4, 4] mm of a pose of Scene.render; None: the endoscope's."""
    if isinstance(pose, np.ndarray):
        if pose.shape not in ((4, 4), (3, 4)):
            raise InputError("pose", f"it is {list(pose.shape)}.", "Give [4, 4] world_from_camera in mm.")
        pose = " ".join(repr(float(each)) for each in pose.ravel())
    return pose_of(scene, parse_pose(pose) if isinstance(pose, str) else pose)


def reconstruct(
    clip: Clip | DepthClip,
    *,
    method: str = "fast",
    budget_s: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    holdout: str = "every8",
    device: str = "auto",
    out: FilePath | None = None,
    on_progress: Callable[[Progress], None] = ignore,
    should_stop: Callable[[], bool] = never,
    **options: object,
) -> Scene:
    """Train a scene from a clip.

    Args:
        clip: the result of `read_clip` or of `Clip.with_depth`.
        method: instant, fast, quality and small are ours; paper is Deform3DGS as published. The API's `preset`.
        budget_s: about how many seconds to train, often less; None: the method's own.
        iterations: the exact number of steps instead; then the same seed on the same machine gives identical bits.
        seed: seed of all random numbers.
        holdout: frames to measure quality on, never to train on: every8, blocks8, none, or numbers such as "1,9,17".
        device: auto, cpu or cuda.
        out: the folder for the scene's files; the same call on the folder of a stopped run resumes it. None: a
            temporary folder, which is deleted when the scene is no longer used.
        on_progress: receives a Progress between steps, for instance `print`.
        should_stop: called between steps; True ends the run.
        options: eyes, use_frames, fov, poses (auto, given, fixed or estimate; read_clip takes a file of them),
            min_depth_mm, max_depth_mm, keep_recorded, as `intrasplat reconstruct --help` explains them.

    Raises:
        InputError: the clip or an option cannot be used; it names the argument and the remedy.
        UnavailableError: the device is missing, or the disk is full.
        TrainingDiverged: training produced NaN or infinity.
        Cancelled: should_stop() returned True.

    Example:
        >>> clip = isp.read_clip(frames, depth_mm=depth_mm, intrinsics=camera)
        >>> scene = isp.reconstruct(clip, method="fast", iterations=4, device="cpu")
        >>> scene.report.psnr_tissue_db > 10
        True
    """
    laid_out = clip.options.model_dump() if isinstance(clip, Clip) else {}
    given = {"budget_s": budget_s, "iterations": iterations, **options}
    named = {"preset": method, "seed": seed, "holdout": holdout} | {k: v for k, v in given.items() if v is not None}
    try:
        chosen = parse_options(ReconstructionOptions, {**laid_out, **named})
    except InputError as error:
        field = error.field.removeprefix(f"{FIELD_PREFIX}.")
        raise InputError("method" if field == "preset" else field, error.problem, error.remedy) from error
    hooks = TrainingHooks(on_progress=on_progress, should_stop=should_stop)
    if out is not None and (Path(out) / MANIFEST).exists():
        raise InputError("out", f"{os.fspath(out)} holds a finished scene.", "Name a new folder, or load() it.")
    request = ReconstructionRequest(clip=Path(), options=chosen, device=device)
    source = clip.source if isinstance(clip, Clip) else clip
    segmenter = clip.segmenter if isinstance(clip, Clip) else None
    poses = clip.poses if isinstance(clip, Clip) else None
    if isinstance(source, ClipPaths):
        request = dataclasses.replace(
            request, clip=source.clip, right=source.right, calibration=source.calibration, masks=source.masks,
            fov_mask=source.fov_mask, segmenter=segmenter, poses=poses,
        )  # fmt: skip
    elif isinstance(source, DepthClip):
        request = dataclasses.replace(request, clip=source, segmenter=segmenter, poses=poses)
    else:
        assert isinstance(clip, Clip)
        matched = clip.with_depth(device=device, on_progress=on_progress, options=chosen)
        request = dataclasses.replace(request, clip=matched)
    if out is not None:
        run_pipeline(request, Path(out), hooks)
        return Scene(Path(out), device)
    folder = Path(tempfile.mkdtemp(prefix="intrasplat-"))
    try:
        run_pipeline(request, folder, hooks)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    scene = Scene(folder, device)
    weakref.finalize(scene, shutil.rmtree, folder, ignore_errors=True)  # also at the end of the process
    return scene


def load(folder: FilePath, *, device: str = "auto") -> Scene:
    """The scene in a folder that `Scene.save`, `reconstruct(out=...)` or the command line wrote.

    Raises:
        InputError: the folder contains no scene.
        SceneError: a file is damaged, or written by another version.

    Example:
        >>> scene.save(tmp / "again")
        >>> isp.load(tmp / "again").intrinsics == scene.intrinsics
        True
    """
    path = Path(folder)
    check_is_scene(path, "folder")
    scene = Scene(path, device)
    _ = scene.trained  # raises here if a file is damaged, not at the first render
    return scene
