"""`intrasplat render`: write images of a scene."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from pydantic import ValidationError

from intrasplat.commands.arguments import finite, positive
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode, flag_of
from intrasplat.errors import InputError
from intrasplat.names import Detail, Light, Smoke
from intrasplat.notices import Notice, NoticeCode, Severity
from intrasplat.picture import (
    MAX_RENDER_PIXELS,
    Highlights,
    ImageFormat,
    IntrinsicsOverride,
    Layer,
    Unseen,
    check_depth_ends,
)

if TYPE_CHECKING:  # imported when needed, as it imports torch
    from intrasplat.scene.scene import TrainedScene

SUFFIX_FORMATS = {
    ".png": ImageFormat.PNG,
    ".jpg": ImageFormat.JPEG,
    ".jpeg": ImageFormat.JPEG,
    ".webp": ImageFormat.WEBP,
    ".npy": ImageFormat.NPY,
}


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `render`; run_cli reads them."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the folder that reconstruct wrote")
    when = parser.add_mutually_exclusive_group(required=True)
    when.add_argument("--t", type=finite, help="time: 0 is the first frame, 1 the end of the clip")
    when.add_argument("--frames", type=_frames, metavar="LIST", help="frame numbers such as 1,9,17; writes a folder")
    parser.add_argument(
        "--pose",
        help="world_from_camera, 12 or 16 numbers in mm, or orbit:YAW,PITCH,ZOOM[,X,Y,Z]: degrees, times nearer, "
        "and the point looked at in mm "
        "(default: the endoscope's own)",
    )
    camera = {"width": "of the image", "height": "of the image", "fx": "focal length", "fy": "focal length"}
    for name, what in (camera | {"cx": "optical axis from the left edge", "cy": "from the upper edge"}).items():
        kind = int if name in ("width", "height") else float
        parser.add_argument(f"--{name}", type=kind, metavar="PX", help=f"{what}, in pixels (default: the clip's)")
    parser.add_argument(
        "--layer",
        choices=[layer.value for layer in Layer],
        default=Layer.RGB.value,
        help="depth: 16-bit PNG in 0.01 mm, or NPY in mm, 0 where there is none; confidence: 0 to 1; error: levels "
        "of 255 by which the model differs from the recorded frame nearest to the time (default: rgb)",
    )
    for end, colour in (("near", "brightest"), ("far", "darkest")):
        parser.add_argument(
            f"--{end}-mm",
            type=positive,
            metavar="MM",
            help=f"of --layer depth as JPEG or WebP: the depth of the {colour} colour (default: the clip's)",
        )
    parser.add_argument(
        "--unseen",
        choices=[each.value for each in Unseen],
        default=Unseen.MARK.value,
        help="what to show where no frame of the clip saw anything: mark: a hatch, transparent in PNG and WebP, and "
        "depth and confidence 0; guess: what the model draws there (default: mark)",
    )
    parser.add_argument(
        "--light",
        choices=get_args(Light),
        default="steady",
        help="where exposure or white balance change, or the border is dark: steady: colours in the even light of one "
        "frame; recorded: in that of the moment (default: steady)",
    )
    parser.add_argument(
        "--smoke",
        choices=get_args(Smoke),
        default="remove",
        help="show: behind the smoke that was found before the tissue; remove: without it (default: remove)",
    )
    parser.add_argument(
        "--detail",
        choices=get_args(Detail),
        default="on",
        help="on: with what the model misses of the recorded frames nearest in time, if they are kept; off: the model "
        "alone (default: on)",
    )
    parser.add_argument(
        "--highlights",
        choices=[each.value for each in Highlights],
        default=Highlights.ON.value,
        help="off: colours without the highlights that were separated by comparing both eyes of a stereo clip; a "
        "scene of one eye has none and is shown as it is (default: on)",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="PATH", help="a .png, .jpg or .npy file; with --frames a folder"
    )
    add_device(parser, "cpu")  # a GPU takes longer to start than the CPU takes for a few images


def _frames(text: str) -> list[int]:
    try:
        frames = [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list such as 1,9,17") from None
    if min(frames) < 0:
        raise argparse.ArgumentTypeError("frames count from 0")
    return frames


def run_cli(options: argparse.Namespace) -> int:
    """Render the images and return the exit code.

    Raises:
        InputError: there is no scene, or an option cannot be used with it.
        UnavailableError: the device is missing.
    """
    from intrasplat.pose import parse_pose
    from intrasplat.scene.checkpoint import check_is_scene, load_scene
    from intrasplat.splat.backend import choose_device
    from intrasplat.view.camera import camera_of, pose_of
    from intrasplat.view.encode import FOR_EYES, encode_layer
    from intrasplat.view.error import AS_RECORDED, check_comparable, error_levels
    from intrasplat.view.recorded import stored_picture
    from intrasplat.view.render import render_frame
    from intrasplat.view.renderer import renderer_of

    device = choose_device(options.device)
    with _naming_option():
        check_depth_ends(options.near_mm, options.far_mm)
    check_is_scene(options.scene, "SCENE")
    scene = load_scene(options.scene)
    layer = Layer(options.layer)
    wanted = _camera(options)
    camera = camera_of(scene.intrinsics, wanted, MAX_RENDER_PIXELS)
    asked_pose = None if options.pose is None else parse_pose(options.pose)
    pose, is_error = pose_of(scene, asked_pose), layer is Layer.ERROR
    how = vars(options)
    if is_error:
        check_comparable(asked_pose, wanted)
        how = {**how, **AS_RECORDED}
    highlights = Highlights(how["highlights"]).shown_in(layer)
    shown = dict[NoticeCode, list[tuple[str, Notice]]]()
    for t, path in _targets(options, scene.frame_count):
        image_format = SUFFIX_FORMATS.get(path.suffix.lower())
        if image_format is None:
            raise InputError("--out", f"{path.name!r} has no known ending.", f"Use {', '.join(SUFFIX_FORMATS)}.")
        recorded = stored_picture(options.scene, scene.frame_count, t) if is_error else None
        frame = render_frame(
            scene, t if recorded is None else recorded.index / scene.frame_count, pose, camera, device,
            highlights=highlights, light=how["light"], smoke=how["smoke"],
            detail=how["detail"] if layer is Layer.RGB else "off",
        )  # fmt: skip
        range_mm = None
        if layer is Layer.DEPTH and image_format in FOR_EYES:
            with _naming_option():
                range_mm = renderer_of(scene, device).depth_range.chosen(pose, options.near_mm, options.far_mm)
        path.parent.mkdir(parents=True, exist_ok=True)
        error = None if recorded is None else error_levels(frame.rgb, recorded, frame.unseen)
        unseen = Unseen(options.unseen)
        path.write_bytes(encode_layer(frame, layer, image_format, unseen=unseen, depth_range_mm=range_mm, error=error))
        print(path)
        for notice in frame.warnings:
            shown.setdefault(notice.code, []).append((path.name, notice))
    for pictures in shown.values():
        (name, notice), many = pictures[0], len(pictures) - 1
        where = f" ({many + 1} images, the first is {name}, the last {pictures[-1][0]})" if many else ""
        print(f"{notice.severity}: {notice.text}{where}", file=sys.stderr)
    for text in _without_effect(options, scene):
        print(f"{Severity.INFO}: {text}", file=sys.stderr)
    return ExitCode.OK


@contextmanager
def _naming_option() -> Iterator[None]:
    """Name the option in an InputError about the parameter of a view."""
    try:
        yield
    except InputError as error:
        raise InputError(flag_of(error.field), error.problem, error.remedy) from error


def _without_effect(options: argparse.Namespace, scene: TrainedScene) -> Iterator[str]:
    """Why an option changes nothing."""
    from intrasplat.view.encode import FOR_EYES

    if (options.near_mm, options.far_mm) != (None, None):
        has_colours = options.frames is None and SUFFIX_FORMATS.get(options.out.suffix.lower()) in FOR_EYES
        if options.layer != Layer.DEPTH or not has_colours:
            yield "Only depth as JPEG or WebP has false colours: --near-mm and --far-mm change nothing."
    if options.smoke == "show" and scene.veil is None:
        yield "No smoke was found in the clip of this scene: --smoke show changes nothing."
    if options.light == "recorded" and scene.log_gains is None and scene.vignetting is None:
        yield "The light of the clip of this scene hardly changes: --light recorded changes nothing."


def _camera(options: argparse.Namespace) -> IntrinsicsOverride:
    """The parts of the camera that the caller gave."""
    try:
        return IntrinsicsOverride(**{name: getattr(options, name) for name in IntrinsicsOverride.model_fields})
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{first['input']} is not accepted: {first['msg']}."
        raise InputError(f"--{first['loc'][0]}", problem, "Give pixels of a usual size.") from error


def _targets(options: argparse.Namespace, frame_count: int) -> list[tuple[float, Path]]:
    """Model times and the files to write: frame i of T is shown at t = i / T and written as 00000i.png."""
    if options.frames is None:
        return [(options.t, options.out)]
    beyond = [frame for frame in options.frames if frame >= frame_count]
    if beyond:
        raise InputError("--frames", f"{beyond[0]} is not there.", f"The clip has frames 0 to {frame_count - 1}.")
    return [(frame / frame_count, options.out / f"{frame:06d}.png") for frame in options.frames]
