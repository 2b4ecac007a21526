"""The commands of live feeds: `intrasplat feeds` with open, list, pause, resume, cut and end."""

from __future__ import annotations

import argparse
import json
from contextlib import AbstractContextManager
from pathlib import Path

from client.connected import connected
from client.remote import add_service
from contract.wire.labels import NO_NAMES
from intrasplat.commands.arguments import Commands, add_command, add_options, count, given_options, positive
from intrasplat.commands.exits import ExitCode
from intrasplat.options import JobOptions
from intrasplat_client import Client, FeedView, NotFound

MOMENTS = "live, seconds before that (-30), seconds of the source, or a time such as 2026-05-04T10:20:30Z"


def add_feeds(commands: Commands) -> None:
    """Add `feeds` and its commands."""
    parser = commands.add_parser("feeds", help="open, list, pause, cut and end live feeds", description="Live feeds.")
    own: Commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    opened = add_command(own, "open", "open a live feed and print its id", _open)
    opened.add_argument(
        "source", metavar="SOURCE", nargs="?", help="rtsp://, tcp://, udp://, http://, a file, a device; none: a push"
    )
    opened.add_argument("--calibration", type=Path, required=True, metavar="F", help="JSON, OpenCV YAML or ini")
    opened.add_argument("--layout", choices=("auto", "sbs", "tb", "two"), help="how two eyes arrive (default: auto)")
    opened.add_argument("--label", metavar="TEXT", help=f"a text to find the feed by. {NO_NAMES}")
    opened.add_argument("--keep-s", type=positive, metavar="S", help="seconds of the past that can be viewed and cut")
    opened.add_argument("--width", type=count, metavar="PX", help="of the pictures that the model learns")
    opened.add_argument("--camera", choices=("fixed", "moving"), help="moving: separate its motion from the tissue's")
    listed = add_command(own, "list", "list the open feeds, newest first", _list)
    pause = add_command(own, "pause", "stop reading and recording now", _pause)
    resume = add_command(own, "resume", "go on after a pause", _resume)
    cut = add_command(own, "cut", "make a job of a part of the recording and print its id", _cut)
    end = add_command(own, "end", "end a feed and delete all that belongs to it", _end)
    for command in (pause, resume, cut, end):
        command.add_argument("feed", metavar="FEED", help="the id that open printed")
    cut.add_argument("start", metavar="FROM", help=MOMENTS)
    cut.add_argument("end", metavar="TO", nargs="?", default="live", help="the same (default: live)")
    add_options(cut, JobOptions)
    cut.add_argument("--label", metavar="TEXT", help=f"a text to find the job by. {NO_NAMES}")
    for command in (opened, listed, pause, resume, cut, end):
        add_service(command)


def _client(options: argparse.Namespace) -> AbstractContextManager[Client]:
    return connected(options.url, options.api_key, {NotFound: "`intrasplat feeds list` lists what there is."})


def _open(options: argparse.Namespace) -> int:
    with _client(options) as client:
        feed = client.open_feed(
            options.calibration,
            options.source,
            layout=options.layout,
            label=options.label,
            keep_s=options.keep_s,
            width=options.width,
            camera=options.camera,
        )
    print(feed.id)
    return ExitCode.OK


def _list(options: argparse.Namespace) -> int:
    with _client(options) as client:
        for feed in client.feeds():
            print(line_of(feed))
    return ExitCode.OK


def line_of(feed: FeedView) -> str:
    """A feed in one line."""
    parts = [feed.id, f"{feed.state:<10}"]
    if feed.label is not None:
        parts.append(f"[{feed.label}]")
    if feed.reason is not None:
        parts.append(str(feed.reason))
    if feed.model_age_s is not None:
        parts.append(f"{feed.used_fps:.1f} of {feed.received_fps:.1f} pairs/s, {feed.model_age_s:.1f} s old")
    return "  ".join(parts).rstrip()


def _pause(options: argparse.Namespace) -> int:
    with _client(options) as client:
        print(client.pause_feed(options.feed).state)
    return ExitCode.OK


def _resume(options: argparse.Namespace) -> int:
    with _client(options) as client:
        print(client.resume_feed(options.feed).state)
    return ExitCode.OK


def _cut(options: argparse.Namespace) -> int:
    chosen = given_options(options, JobOptions).model_dump(exclude_unset=True)
    with _client(options) as client:
        print(client.cut_feed(options.feed, options.start, options.end, label=options.label, **chosen).id)
    return ExitCode.OK


def _end(options: argparse.Namespace) -> int:
    with _client(options) as client:
        print(json.dumps(client.end_feed(options.feed).model_dump(), indent=1))
    return ExitCode.OK
