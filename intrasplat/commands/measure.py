"""`intrasplat measure`: print depths and distances in a scene as JSON."""

from __future__ import annotations

import argparse
from pathlib import Path

from intrasplat.commands.arguments import finite
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode
from intrasplat.measuring import ShapeKind, check_shape, parse_points


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `measure`; run_cli reads them."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the folder that reconstruct wrote")
    parser.add_argument(
        "--points",
        required=True,
        metavar="X,Y;X,Y",
        help="points in pixels of the clip's left eye, from its upper left; of two the distance at every frame, too",
    )
    parser.add_argument(
        "--shape",
        type=ShapeKind,
        choices=list(ShapeKind),
        help="what the points make together, at every frame: line: straight pieces from point to point; area: a "
        "polygon of flat triangles; angle: at the second of 3 points",
    )
    parser.add_argument("--t", type=finite, default=0.0, help="time: 0 is the first frame, 1 the end of the clip")
    parser.add_argument(
        "--pose", help="where the points are seen from, as render has it (default: the endoscope's own)"
    )
    add_device(parser, "cpu")


def run_cli(options: argparse.Namespace) -> int:
    """Print a Measurement (intrasplat/measuring.py) and return the exit code.

    Raises:
        InputError: there is no scene, or nothing can be measured in it.
        UnavailableError: the device is missing.
    """
    from intrasplat.pose import parse_pose
    from intrasplat.scene.checkpoint import check_is_scene, load_scene
    from intrasplat.splat.backend import choose_device
    from intrasplat.view.camera import pose_of
    from intrasplat.view.measured import measured

    points, device = parse_points(options.points), choose_device(options.device)
    check_shape(options.shape, len(points))
    check_is_scene(options.scene, "SCENE")
    scene = load_scene(options.scene)
    pose = pose_of(scene, None if options.pose is None else parse_pose(options.pose))
    found = measured(scene, options.t, pose, scene.intrinsics, points, device, shape=options.shape)
    print(found.model_dump_json(indent=2))
    return ExitCode.OK
