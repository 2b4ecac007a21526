"""`intrasplat slicer`: the command line of the bridge."""

from __future__ import annotations

import argparse
import asyncio
import threading
from importlib.util import find_spec
from typing import TYPE_CHECKING

import intrasplat_client
from client.connected import command_error
from client.remote import add_service
from client.slicer.say import say
from contract.runtime.settings import LOOPBACK_NAMES
from intrasplat.commands.arguments import Commands, add_command, count, finite
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError, UnavailableError
from intrasplat.machine.processes import heeding_signals
from intrasplat.report import RESEARCH_USE

if TYPE_CHECKING:
    from client.slicer.bridge import Bridge, ShownChoice

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 18944
PATIENCE_S = 2.0
"""How long a call is repeated before the bridge reports to peers that the service does not answer."""
MAX_DEVICE_CHARACTERS = 20


def add_slicer(commands: Commands) -> None:
    """Add the parser of this command."""
    parser = add_command(
        commands, "slicer", "show a finished scene in 3D Slicer (OpenIGTLink), until a signal ends it", _slicer
    )
    parser.add_argument("scene", metavar="SCENE", help="the id that submit printed")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"for Slicer (default: {DEFAULT_PORT})")
    parser.add_argument(
        "--host",
        default=DEFAULT_HOST,
        help=f"address to listen on (default: {DEFAULT_HOST}, for this machine alone); OpenIGTLink has neither keys "
        "nor encryption",
    )
    parser.add_argument(
        "--connect", action="store_true", help="connect to a Slicer that listens at --host and --port, instead"
    )
    parser.add_argument("--t", type=finite, help="stand at this time, a fraction of the clip (default: play)")
    parser.add_argument("--width", type=count, metavar="PX", help="of the picture (default: the clip's)")
    parser.add_argument("--depth", action="store_true", help="send the depth in mm, too, as a second picture")
    parser.add_argument(
        "--surface",
        choices=("standing", "always", "never"),
        default="standing",
        help="when to send it: of a moment that stands; also while the clip plays; never (default: standing)",
    )
    parser.add_argument(
        "--pose-device",
        metavar="NAME",
        default="IntrasplatPose",
        help="of the transform from Slicer that is the camera's pose (default: IntrasplatPose)",
    )
    add_service(parser)


def _slicer(options: argparse.Namespace) -> int:
    if find_spec("pyigtl") is None:
        raise UnavailableError("pyigtl is not installed.", "pip install 'intrasplat-server[slicer]'")
    from client.slicer.bridge import ShownChoice

    if not 0 <= options.port < 1 << 16:
        raise InputError("--port", f"{options.port} is no port.", "Choose one below 65536.")
    if not 0 < len(options.pose_device.encode()) <= MAX_DEVICE_CHARACTERS:
        problem = f"{options.pose_device!r} is not 1 to {MAX_DEVICE_CHARACTERS} characters long."
        raise InputError("--pose-device", problem, "Rename the transform in Slicer.")
    choice = ShownChoice(options.scene, options.width, options.depth, options.surface, options.pose_device)
    with heeding_signals() as end:
        try:
            asyncio.run(_run(options, choice, end))
        except intrasplat_client.IntrasplatError as error:
            raise command_error(error) from error
    return ExitCode.OK


async def _run(options: argparse.Namespace, choice: ShownChoice, end: threading.Event) -> None:
    from client.slicer.bridge import Bridge
    from client.slicer.playback import Playback
    from client.slicer.status import Status

    async with intrasplat_client.AsyncClient(options.url, api_key=options.api_key, patience_s=PATIENCE_S) as client:
        report = await client.report(choice.scene, scores_within_s=0)
        playback = Playback(report.frame_times_s, options.t)
        if options.t is not None and (note := playback.note_on(options.t)):
            say(f"warning: {note}")
        bridge = Bridge(client, choice, playback, Status(playback, report))
        carrying = asyncio.create_task(_carry(bridge, options))
        showing = asyncio.create_task(bridge.run(end))
        done, _ = await asyncio.wait([carrying, showing], return_when=asyncio.FIRST_COMPLETED)
        for task in (carrying, showing):
            task.cancel()
        await asyncio.gather(carrying, showing, return_exceptions=True)
        for task in done:
            task.result()


async def _carry(bridge: Bridge, options: argparse.Namespace) -> None:
    """Listen for peers, or connect to a peer that listens."""
    if options.connect:
        say(f"connecting to OpenIGTLink at {options.host}:{options.port}")
        await bridge.link.reach(options.host, options.port)
    if options.host not in LOOPBACK_NAMES:
        say("warning: OpenIGTLink has neither keys nor encryption; whoever reaches this port sees the scene")
    await bridge.link.listen(
        options.host, options.port, lambda port: say(f"OpenIGTLink at {options.host}:{port}. {RESEARCH_USE}")
    )
