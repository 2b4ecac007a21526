"""Codec, size and duration in a video's header, read without a decoder.

ISO base media (mp4, mov; ISO/IEC 14496-12) is a tree of boxes, Matroska and WebM (RFC 9559) a tree of elements. If the
header lacks a value, the video is not refused here: the decoder in its confined process decides.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits

CODECS: dict[str, tuple[bytes, ...]] = {  # accepted codecs, as containers name them
    "h264": (b"avc1", b"avc2", b"avc3", b"avc4", b"h264", b"H264", b"dva1", b"dvav", b"V_MPEG4/ISO/AVC"),
    "hevc": (b"hvc1", b"hvc2", b"hev1", b"dvh1", b"dvhe", b"V_MPEGH/ISO/HEVC"),
    "vp9": (b"vp09", b"VP90", b"V_VP9"),
    "mjpeg": (b"jpeg", b"mjpg", b"mjpa", b"V_MJPEG"),
}
OTHER_CODECS = {  # codecs that users are likely to bring, with names for errors
    b"av01": "AV1",
    b"V_AV1": "AV1",
    b"V_VP8": "VP8",
    b"mp4v": "MPEG-4 part 2",
    b"apch": "ProRes",
    b"apcn": "ProRes",
    b"V_FFV1": "FFV1",
    b"V_MPEG4/ISO/ASP": "MPEG-4 part 2",
    b"encv": "encrypted video",
}
REMEDY = "Give H.264, HEVC, VP9 or Motion JPEG video in mp4, mov, mkv or webm."

EBML = b"\x1aE\xdf\xa3"  # first bytes of Matroska and WebM
_PICTURE_BOXES = (b"mdat", b"moof", b"sidx", b"styp", b"free", b"skip", b"wide")  # they may follow the header
_FIRST_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_MAX_HEADER_BYTES = 32 << 20  # of moov, or before Matroska's first pictures; 1000 frames take some kB
_MAX_PARTS = 10_000  # boxes or elements read
_ACCEPTED = frozenset(name for names in CODECS.values() for name in names)

_SEGMENT, _TRACKS, _CLUSTER = 0x18538067, 0x1654AE6B, 0x1F43B675
_TRACK_ENTRY, _TRACK_TYPE, _CODEC_ID, _VIDEO, _WIDTH, _HEIGHT = 0xAE, 0x83, 0x86, 0xE0, 0xB0, 0xBA
_VIDEO_TYPE = 1


@dataclass(frozen=True)
class VideoTrack:
    """A video track. Numbers are 0 if the header lacks them; `shown` is the display size.

    is_bounded: False if nothing tells where the file ends, as in a live stream.
    """

    codec: bytes
    width: int = 0
    height: int = 0
    shown: tuple[int, int] = (0, 0)
    frames: int = 0
    duration_s: float = 0.0
    is_bounded: bool = True


def is_video(head: bytes) -> bool:
    """Whether a file with these first bytes is ISO base media (its first box is named at byte 4) or Matroska."""
    return head[4:8] in _FIRST_BOXES or head.startswith(EBML)


def check_is_video(head: bytes, field: str, label: str) -> None:
    """InputError if a file with these first bytes is no video."""
    if not is_video(head):
        raise InputError(field, f"{label} is not an mp4, mov, mkv or webm file.", REMEDY)


def is_matroska(path: Path) -> bool:
    """Whether the file is Matroska or WebM."""
    with path.open("rb") as file:
        return file.read(4) == EBML


def check_video(path: Path, field: str, label: str, limits: ClipLimits) -> VideoTrack:
    """The track to decode, after all checks that need no decoder.

    Raises:
        InputError: it is not a video, has no header, or its codec is not accepted.
        LimitError: by its header it is too large, too long, or has too many frames.
    """
    with path.open("rb") as file:
        check_is_video(file.read(12), field, label)
        try:
            tracks = video_tracks(file)
        except (ValueError, struct.error) as error:
            problem = f"{label} is cut short or damaged: {error}."
            raise InputError(field, problem, "Copy or export it again.") from None
    if not tracks:
        raise InputError(field, f"{label} has no video track.", REMEDY)
    track = next((track for track in tracks if track.codec in _ACCEPTED), None)
    if track is None:
        codec = OTHER_CODECS.get(tracks[0].codec) or repr(tracks[0].codec.decode("latin-1"))
        raise InputError(field, f"{label} is encoded as {codec}, which is not accepted.", REMEDY)
    for width, height in ((track.width, track.height), track.shown):
        if width and height:
            limits.check_frame(field, label, width, height)
    if track.width and track.height:
        limits.check_clip(field, label, track.frames, track.width, track.height)
    limits.check_duration(field, label, track.duration_s)
    return track


def video_tracks(file: BinaryIO) -> list[VideoTrack]:
    """The video tracks that the header describes.

    Raises:
        ValueError: the header is missing, cut short, too large, or contradicts itself.
    """
    file_bytes = file.seek(0, io.SEEK_END)
    file.seek(0)
    is_ebml = file.read(4) == EBML
    file.seek(0)
    return _matroska_tracks(file, file_bytes) if is_ebml else _iso_tracks(file, file_bytes)


def _iso_tracks(file: BinaryIO, file_bytes: int) -> list[VideoTrack]:
    start, tracks = 0, None
    for _ in range(_MAX_PARTS):
        if start + 8 > file_bytes:
            break
        file.seek(start)
        head = file.read(16)
        if tracks is not None and head[4:8] not in _PICTURE_BOXES:
            break
        header_bytes, size = _box_size(head, file_bytes - start)
        if head[4:8] == b"mdat" and start + size > file_bytes:
            raise ValueError("its media data (mdat) ends after the file does")
        if head[4:8] == b"moov":
            if start + size > file_bytes:
                raise ValueError("its header (moov) ends after the file does")
            if size > _MAX_HEADER_BYTES:
                raise ValueError(f"its header (moov) has {size} bytes")
            file.seek(start + header_bytes)
            tracks = _moov_tracks(file.read(size - header_bytes))
        start += size
    if tracks is None:
        raise ValueError("it has no header (moov)")
    return tracks


def _box_size(head: bytes, max_bytes: int) -> tuple[int, int]:
    """Bytes of the box's own header, and bytes of the whole box."""
    (size,) = struct.unpack_from(">I", head)
    if size == 1:
        (size,) = struct.unpack_from(">Q", head, 8)
        if size < 16:
            raise ValueError(f"a box of {size} bytes")
        return 16, size
    if size == 0:  # the box extends to the end of the file
        return 8, max_bytes
    if size < 8:
        raise ValueError(f"a box of {size} bytes")
    return 8, size


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The (name, content) of consecutive boxes in data."""
    start = 0
    for _ in range(_MAX_PARTS):
        if start + 8 > len(data):
            return
        header_bytes, size = _box_size(data[start : start + 16].ljust(16, b"\0"), len(data) - start)
        if start + size > len(data):
            raise ValueError("a box ends after the one it stands in")
        yield data[start + 4 : start + 8], data[start + header_bytes : start + size]
        start += size
    raise ValueError(f"it has more than {_MAX_PARTS} boxes in one")


def _inside(data: bytes, *path: bytes) -> bytes | None:
    """The content of the first box at that path."""
    for name in path:
        found = next((content for box, content in _boxes(data) if box == name), None)
        if found is None:
            return None
        data = found
    return data


def _moov_tracks(moov: bytes) -> list[VideoTrack]:
    tracks = []
    for name, trak in _boxes(moov):
        handler = _inside(trak, b"mdia", b"hdlr") if name == b"trak" else None
        if handler is None or handler[8:12] != b"vide":
            continue
        description = _inside(trak, b"mdia", b"minf", b"stbl", b"stsd") or b""
        for codec, entry in _boxes(description[8:]):
            width, height = struct.unpack_from(">HH", entry, 24)
            tracks.append(VideoTrack(codec, width, height, _shown(trak), _samples(trak), _duration_s(trak)))
    return tracks


def _shown(trak: bytes) -> tuple[int, int]:
    header = _inside(trak, b"tkhd") or b""
    if len(header) < 84:
        return 0, 0
    width, height = struct.unpack_from(">II", header, len(header) - 8)  # fixed point, 16.16
    return width >> 16, height >> 16


def _samples(trak: bytes) -> int:
    """Number of frames in the table of sample sizes; 0 in fragmented files, whose tables are in the fragments."""
    table = _inside(trak, b"mdia", b"minf", b"stbl", b"stsz") or _inside(trak, b"mdia", b"minf", b"stbl", b"stz2")
    return 0 if table is None else int(struct.unpack_from(">I", table, 8)[0])


def _duration_s(trak: bytes) -> float:
    header = _inside(trak, b"mdia", b"mdhd")
    if header is None:
        return 0.0
    long = header[0] == 1
    rate, duration = struct.unpack_from(">IQ" if long else ">II", header, 20 if long else 12)
    unknown = 0xFFFFFFFFFFFFFFFF if long else 0xFFFFFFFF
    return 0.0 if rate == 0 or duration == unknown else duration / rate


def _matroska_tracks(file: BinaryIO, file_bytes: int) -> list[VideoTrack]:
    """The tracks that are described before the first pictures. ValueError if there are none, or the file is cut.

    The duration is that of the longest track, from a clock that may start anywhere, so it tells nothing.
    """
    data = file.read(min(file_bytes, _MAX_HEADER_BYTES))
    tracks: list[VideoTrack] = []
    is_bounded = True
    for segment, content, end in _elements_to(data):
        if segment != _SEGMENT:
            continue
        is_bounded = end is not None
        if end is not None and end > file_bytes:
            raise ValueError("its segment ends after the file does")
        for element, inner in _elements(content):
            if element == _CLUSTER:
                break
            if element == _TRACKS:
                tracks = [track for each, entry in _elements(inner) if each == _TRACK_ENTRY for track in _track(entry)]
        break
    if not tracks:
        raise ValueError("it describes no video track before its pictures")
    return [replace(track, is_bounded=is_bounded) for track in tracks]


def _track(entry: bytes) -> Iterator[VideoTrack]:
    values = dict(_elements(entry))
    if int.from_bytes(values.get(_TRACK_TYPE, b""), "big") == _VIDEO_TYPE:
        size = dict(_elements(values.get(_VIDEO, b"")))
        width, height = (int.from_bytes(size.get(each, b"")[:8], "big") for each in (_WIDTH, _HEIGHT))
        yield VideoTrack(values.get(_CODEC_ID, b"").rstrip(b"\0"), width, height)


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The (id, content) of consecutive elements in data; the last may be cut off or of unknown size."""
    for name, content, _ in _elements_to(data):
        yield name, content


def _elements_to(data: bytes) -> Iterator[tuple[int, bytes, int | None]]:
    """Like _elements, with the place where each says that it ends; None if it does not say so."""
    start = 0
    for _ in range(_MAX_PARTS):
        if start >= len(data):
            return
        id_bytes = _length_of_number(data[start], 4)
        size_at = start + id_bytes
        if size_at >= len(data):
            return
        size_bytes = _length_of_number(data[size_at], 8)
        content_at = size_at + size_bytes
        mask = (1 << 7 * size_bytes) - 1
        size = int.from_bytes(data[size_at:content_at], "big") & mask
        end = None if size == mask else content_at + size
        yield int.from_bytes(data[start:size_at], "big"), data[content_at:end], end
        if end is None:
            return
        start = end
    raise ValueError(f"it has more than {_MAX_PARTS} elements in one")


def _length_of_number(first: int, max_length: int) -> int:
    """Length of a number in bytes, by the leading zeros of its first byte."""
    length = 9 - first.bit_length()
    if length > max_length:
        raise ValueError("an element's size or name is none")
    return length
