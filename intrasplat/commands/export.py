"""`intrasplat export`: writes a scene that is on this machine as a file for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from contract.runtime.settings import Settings
from intrasplat.commands.arguments import add_options
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode, flag_of
from intrasplat.errors import InputError
from intrasplat.formats import EXPORT_FORMATS, ExportOptions, check_export
from intrasplat.names import MANIFEST
from intrasplat.scene.stored_exports import stored_parts


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `export`; run_cli reads them."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the folder that reconstruct wrote")
    formats = "; ".join(f"{name}: {each.about}" for name, each in EXPORT_FORMATS.items())
    parser.add_argument("--format", default="ply", metavar="FORMAT", help=f"{formats} (default: ply)")
    add_options(parser, ExportOptions)
    parser.add_argument("--out", type=Path, metavar="PATH", help="the file (default: beside SCENE, under its name)")
    add_device(parser, "cpu")  # a GPU needs longer to begin than the CPU for a few images


def run_cli(options: argparse.Namespace) -> int:
    """Writes the file and returns the exit code. A file that could not be finished is removed.

    Raises:
        InputError: there is no scene, or an option cannot be used with it.
        UnavailableError: the device is not there.
    """
    try:
        chosen = check_export(options.format, {name: getattr(options, name) for name in ExportOptions.model_fields})
    except InputError as error:
        raise InputError(flag_of(error.field), error.problem, error.remedy) from error
    if not (options.scene / MANIFEST).is_file():
        raise InputError("SCENE", f"{options.scene} holds no scene.", "Name a folder that `reconstruct --out` wrote.")
    parts = _parts(options, chosen)
    folder = options.scene.resolve()
    path = options.out or folder.with_name(folder.name + EXPORT_FORMATS[options.format].suffix)
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with unfinished.open("wb") as file:
            for part in parts:
                file.write(part)
        unfinished.replace(path)
    except OSError as error:
        raise InputError("--out", f"{path} cannot be written ({error.strerror}).", "Name another file.") from error
    finally:
        unfinished.unlink(missing_ok=True)
    print(path)
    return ExitCode.OK


def _parts(options: argparse.Namespace, chosen: ExportOptions) -> Iterator[bytes]:
    """The file in parts. A format of the stored files needs no torch."""
    if EXPORT_FORMATS[options.format].is_stored:
        return stored_parts(options.format, options.scene, None, Settings.from_environment().dashboard_dir)
    from intrasplat.export import export_parts
    from intrasplat.scene.checkpoint import load_scene
    from intrasplat.splat.backend import choose_device

    return export_parts(load_scene(options.scene), options.format, chosen, choose_device(options.device))
