"""`python -m intrasplat.live.cutting`: the confined process that joins recorded parts into one file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.container
import av.error

from intrasplat.decode.reports import Reports
from intrasplat.errors import InputError

TICK = Fraction(1, 90_000)
OUTPUT = "cut"
REMEDY = "Give another range."


@dataclass(frozen=True)
class _Packet:
    data: bytes
    is_key: bool
    pts_s: float
    dts_s: float


def cut(request: dict[str, Any], folder: Path, reports: Reports) -> dict[str, Any]:
    """Write `folder`/cut. Returns its range, frames and container.

    Raises:
        InputError: the parts hold no frames, or cannot be read.
    """
    from_s, to_s = float(request["from_s"]), float(request["to_s"])
    parts, is_whole = _of_one_coding(request["parts"])
    container = "mkv" if parts[-1][1].startswith("mjpeg") else "mp4"
    start_s, times, frames = _start(parts, from_s, reports), [float("inf"), float("-inf")], 0
    try:
        with (
            av.open(str(parts[-1][0]["path"]), format="mov", options=_LOCAL) as like,
            av.open(
                str(folder / OUTPUT), "w", format="matroska" if container == "mkv" else "mp4", options=_INDEX
            ) as out,
        ):
            stream = out.add_stream_from_template(like.streams.video[0])
            zero_s, last = None, -1
            for packet in _packets(parts):
                reports.picture()
                if packet.pts_s < start_s and zero_s is None:
                    continue
                if packet.is_key and packet.pts_s > to_s and frames:
                    break
                zero_s = packet.dts_s if zero_s is None else zero_s
                muxed: av.Packet[Any] = av.Packet(packet.data)
                last = max(last + 1, round((packet.dts_s - zero_s) / TICK))
                muxed.dts, muxed.pts = last, max(last, round((packet.pts_s - zero_s) / TICK))
                muxed.time_base, muxed.is_keyframe, muxed.stream = TICK, packet.is_key, stream
                out.mux(muxed)
                frames += 1
                times = [min(times[0], packet.pts_s), max(times[1], packet.pts_s)]
    except (av.error.FFmpegError, ValueError) as error:
        raise InputError("from", f"the recorded parts cannot be joined ({type(error).__name__}).", REMEDY) from error
    if not frames:
        raise InputError("from", "no key frame is recorded in this range.", REMEDY)
    return {"from_s": times[0], "to_s": times[1], "frames": frames, "is_whole": is_whole, "container": container}


_LOCAL = {"protocol_whitelist": "file"}
_INDEX = {"movflags": "faststart"}


def _of_one_coding(parts: list[dict[str, Any]]) -> tuple[list[tuple[dict[str, Any], str]], bool]:
    """The newest parts with one codec, size and parameters, with these; and whether they are all."""
    chosen: list[tuple[dict[str, Any], str]] = []
    for part in reversed(parts):
        coding = _coding(part["path"])
        if coding is None:
            continue
        if chosen and coding != chosen[-1][1]:
            return chosen[::-1], False
        chosen.append((part, coding))
    if not chosen:
        raise InputError("from", "the recorded parts cannot be read.", REMEDY)
    return chosen[::-1], len(chosen) == len(parts)


def _coding(path: str) -> str | None:
    try:
        with av.open(path, format="mov", options=_LOCAL) as container:
            context = container.streams.video[0].codec_context
            parameters = hashlib.sha256(context.extradata or b"").hexdigest()
            return f"{context.codec.name} {context.width} {context.height} {parameters}"
    except (av.error.FFmpegError, ValueError, IndexError):
        return None


def _packets(parts: list[tuple[dict[str, Any], str]]) -> Iterator[_Packet]:
    """All packets in order, with times on the feed's clock."""
    for part, _ in parts:
        with av.open(str(part["path"]), format="mov", options=_LOCAL) as container:
            first: float | None = None
            for packet in container.demux(container.streams.video[0]):
                if not packet.size or packet.pts is None:
                    continue
                pts_s = float(packet.pts * packet.time_base)
                dts_s = pts_s if packet.dts is None else float(packet.dts * packet.time_base)
                first = pts_s if first is None else first
                offset_s = float(part["from_s"]) - first
                yield _Packet(bytes(packet), bool(packet.is_keyframe), pts_s + offset_s, dts_s + offset_s)


def _start(parts: list[tuple[dict[str, Any], str]], from_s: float, reports: Reports) -> float:
    """The time of the last key frame that is not after from_s, else of the first one."""
    found: float | None = None
    for packet in _packets(parts):
        reports.picture()
        if packet.is_key:
            if found is not None and packet.pts_s > from_s:
                break
            found = packet.pts_s
    return from_s if found is None else found


def _cut() -> Any:
    return cut


if __name__ == "__main__":
    from intrasplat.decode.child import serve

    serve(_cut)
