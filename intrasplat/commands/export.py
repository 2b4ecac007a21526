"""`intrasplat export`: write a scene on this machine as a file for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from intrasplat.commands.arguments import add_options
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode, flag_of
from intrasplat.errors import InputError
from intrasplat.formats import EXPORT_FORMATS, ExportOptions, check_export


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `export`; run_cli reads them."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the folder that reconstruct wrote")
    formats = "; ".join(f"{name}: {each.about}" for name, each in EXPORT_FORMATS.items())
    parser.add_argument("--format", default="ply", metavar="FORMAT", help=f"{formats} (default: ply)")
    add_options(parser, ExportOptions)
    parser.add_argument("--out", type=Path, metavar="PATH", help="the file (default: beside SCENE, under its name)")
    add_device(parser, "cpu")  # a GPU takes longer to start than the CPU takes for a few images


def run_cli(options: argparse.Namespace) -> int:
    """Write the file and return the exit code. An unfinished file is removed.

    Raises:
        InputError: there is no scene, or an option cannot be used with it.
        UnavailableError: the device is missing.
    """
    given = {name: getattr(options, name) for name in ExportOptions.model_fields}
    try:
        check_export(options.format, given)
        from intrasplat.reconstruction import Scene
        from intrasplat.scene.checkpoint import check_is_scene

        check_is_scene(options.scene, "SCENE")
        folder = options.scene.resolve()
        path = options.out or folder.with_name(folder.name + EXPORT_FORMATS[options.format].suffix)
        print(Scene(options.scene, options.device).export(path, format=options.format, **given))
    except InputError as error:
        flag = error.field if error.field == "SCENE" else flag_of({"path": "out"}.get(error.field, error.field))
        raise type(error)(flag, error.problem, error.remedy) from error
    return ExitCode.OK
