"""Files that mean harm, made and not stored: each is refused, by name of the input at fault, and nothing else happens.

`refused_at` says who is the first to see it: "upload" what its first bytes or directory show, "decoding" the rest.
"""

from __future__ import annotations

import io
import json
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

VIDEO = Path(__file__).resolve().parents[2] / "data" / "stereo_sbs_h264.mp4"
CALIBRATION = (
    b'{"model": "rectified", "width": 96, "height": 80, "fx_px": 90, "fy_px": 90, "cx_px": 48, "cy_px": 40, '
    b'"baseline_mm": 4}'
)
OPENCV = b"""%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 90., 0., 48., 0., 90., 40., 0., 0., 1. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 90., 0., 48., 0., 90., 40., 0., 0., 1. ]
R: [ 0., 0., 0. ]
T: [ -4., 0., 0. ]
"""
FRAME = "left/000000.png"


@dataclass(frozen=True)
class Hostile:
    """A file of some name with some content, what it is given as, and what must be said of it."""

    filename: str
    make: Callable[[Path], bytes]
    problem: str
    refused_at: Literal["upload", "decoding"] = "upload"
    part: Literal["clip", "calibration", "masks"] = "clip"

    def write(self, folder: Path) -> Path:
        """The file; folder is also where it may be made."""
        path = folder / self.filename
        path.write_bytes(self.make(folder))
        return path


def fixed(content: bytes) -> Callable[[Path], bytes]:
    return lambda folder: content


def calibration(**changes: str) -> bytes:
    """The good calibration with other values, as they are to stand in the file."""
    values = {name: json.dumps(value) for name, value in json.loads(CALIBRATION).items()} | changes
    return ("{" + ", ".join(f'"{name}": {value}' for name, value in values.items()) + "}").encode()


def png(width: int, height: int) -> bytes:
    """A PNG that is nothing but a header of that size and an end."""
    header = b"IHDR" + struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)
    end = b"IEND"
    chunks = [struct.pack(">I", len(each) - 4) + each + struct.pack(">I", zlib.crc32(each)) for each in (header, end)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def zipped(*members: tuple[str, bytes], kind: int = stat.S_IFREG) -> bytes:
    """A zip of these members, in this order, under exactly these names; the last is of that kind."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for index, (name, content) in enumerate(members):
            entry = zipfile.ZipInfo("placeholder")
            entry.filename = name
            entry.compress_type = zipfile.ZIP_DEFLATED
            last = index == len(members) - 1
            entry.create_system, entry.external_attr = 3, ((kind if last else stat.S_IFREG) | 0o644) << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def eyes(picture: bytes) -> bytes:
    """A zip of one frame whose eyes are that picture."""
    return zipped((FRAME, picture), (FRAME.replace("left", "right"), picture))


def npy(values: object, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(values, dtype=object if allow_pickle else None), allow_pickle=allow_pickle)
    return buffer.getvalue()


def endonerf(poses: bytes) -> bytes:
    """A clip of the EndoNeRF layout with good pictures and these poses."""
    good = {name: cv2.imencode(".png", np.full((32, 32), 60, np.uint8))[1].tobytes() for name in ("images", "depth")}
    return zipped(*((f"{name}/000000.png", content) for name, content in good.items()), ("poses_bounds.npy", poses))


def poses_with_nan() -> bytes:
    rows = np.zeros((1, 17))
    rows[0, 3] = np.nan
    return npy(rows)


def patched(data: bytes, sign: bytes, offset: int, value: bytes, last: bool = False) -> bytes:
    """data with value written `offset` bytes after the first (or last) place where sign stands."""
    at = (data.rindex(sign) if last else data.index(sign)) + offset
    return data[:at] + value + data[at + len(value) :]


def overlapping() -> bytes:
    """Both members start at byte 0."""
    return patched(eyes(png(64, 64)), b"PK\x01\x02", 42, bytes(4), last=True)


def encrypted() -> bytes:
    return patched(zipped((FRAME, png(64, 64))), b"PK\x01\x02", 8, b"\x01")


def large_frames() -> bytes:
    """The description of the track says 65535 pixels each way."""
    return patched(VIDEO.read_bytes(), b"avc1", 28, b"\xff" * 4, last=True)


def without_pictures() -> bytes:
    """The header is good; where the pictures were, there are zeros."""
    data = VIDEO.read_bytes()
    start = data.index(b"mdat") + 4
    size = struct.unpack(">I", data[start - 8 : start - 4])[0] - 8
    return data[:start] + bytes(size) + data[start + size :]


def black(folder: Path) -> bytes:
    """More frames than are accepted, of which each takes some bytes."""
    return recorded(folder / "black.webm", "VP90", frames=1100)


def magic_yuv(folder: Path) -> bytes:
    return recorded(folder / "magic.mov", "M8RG", frames=2)


def recorded(path: Path, codec: str, frames: int) -> bytes:
    log_level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, (64, 32))
        assert writer.isOpened()
        for _ in range(frames):
            writer.write(np.zeros((32, 64, 3), np.uint8))
        writer.release()
    finally:
        cv2.utils.logging.setLogLevel(log_level)
    data = path.read_bytes()
    path.unlink()
    return data


_CUT_XML = b'<?xml version="1.0"?>\n<opencv_storage>\n<M1>1</M1>\n<M2>1</M2>\n<R>1</R>\n<T>1</T>\n'
_ENTITIES = (
    b'<?xml version="1.0"?><!DOCTYPE o [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]>'
    b"<opencv_storage><M1>&c;</M1></opencv_storage>"
)
_PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"
_VIDEO = VIDEO.read_bytes()

CORPUS: dict[str, Hostile] = {
    "no bytes": Hostile("clip.mp4", fixed(b""), "empty"),
    "a program": Hostile("clip.mp4", fixed(b"\x7fELF" + bytes(200)), "is not an mp4"),
    "a playlist": Hostile("clip.mp4", fixed(_PLAYLIST), "is not an mp4"),
    "a list for ffmpeg": Hostile("clip.mp4", fixed(b"ffconcat version 1.0\nfile /etc/passwd\n"), "is not an mp4"),
    "an archive named png in zip": Hostile("clip.zip", fixed(b"Rar!\x1a\x07" + bytes(99)), "not a zip|not an mp4"),
    "cut before its header ends": Hostile("clip.mp4", fixed(_VIDEO[: _VIDEO.index(b"moov") + 200]), "ends after the"),
    "a box larger than all": Hostile("clip.mp4", fixed(patched(_VIDEO, b"trak", -4, b"\x7f\xff\xff\xff")), "a box"),
    "a box that is none": Hostile("clip.mp4", fixed(patched(_VIDEO, b"trak", -4, bytes(3) + b"\x01")), "box"),
    "MagicYUV": Hostile("clip.mov", magic_yuv, "encoded as 'M8"),
    "huge by its sample entry": Hostile("clip.mp4", fixed(large_frames()), "65535x65535"),
    "huge by its track": Hostile("clip.mp4", fixed(patched(_VIDEO, b"tkhd", 80, b"\xff" * 8)), "65535x65535"),
    "a billion frames": Hostile("clip.mp4", fixed(patched(_VIDEO, b"stsz", 12, b"\x40" + bytes(3))), "1073741824 fr"),
    "a year long": Hostile("clip.mp4", fixed(patched(_VIDEO, b"mdhd", 20, b"\x7f" + bytes(3))), "the limit is 600 s"),
    "no pictures": Hostile("clip.mp4", fixed(without_pictures()), "ends after|cannot be decoded", "decoding"),
    "a bomb of black frames": Hostile("clip.webm", black, "frames or more", "decoding"),
    "out of the folder": Hostile("clip.zip", fixed(zipped(("../../etc/x.png", png(64, 64)))), r'"\.\."'),
    "absolute": Hostile("clip.zip", fixed(zipped(("/etc/x.png", png(64, 64)))), "absolute path"),
    "a drive": Hostile("clip.zip", fixed(zipped(("C:/x.png", png(64, 64)))), "absolute path"),
    "out of the folder by backslashes": Hostile("clip.zip", fixed(zipped(("..\\..\\x.png", png(64, 64)))), r'"\.\."'),
    "a drive by backslashes": Hostile("clip.zip", fixed(zipped(("C:\\x.png", png(64, 64)))), "absolute path"),
    "a link": Hostile("clip.zip", fixed(zipped((FRAME, b"/etc/passwd"), kind=stat.S_IFLNK)), "symbolic link"),
    "a device": Hostile("clip.zip", fixed(zipped((FRAME, b""), kind=stat.S_IFCHR)), "not a plain file"),
    "a zip in a zip": Hostile("clip.zip", fixed(zipped(("more.zip", zipped((FRAME, b""))))), "archive inside"),
    "encrypted": Hostile("clip.zip", fixed(encrypted()), "encrypted"),
    "overlapping members": Hostile("clip.zip", fixed(overlapping()), "overlap"),
    "twice in other case": Hostile("clip.zip", fixed(zipped((FRAME, b""), (FRAME.upper(), b""))), "twice"),
    "zeros": Hostile("clip.zip", fixed(zipped((FRAME, bytes(8 << 20)))), "inflates from"),
    "a giant picture": Hostile("clip.zip", fixed(eyes(png(100_000, 100_000))), "100000x100000"),
    "a picture that is text": Hostile("clip.zip", fixed(eyes(b"GIF89a" + bytes(99))), "is not a PNG"),
    "a picture cut short": Hostile(
        "clip.zip",
        fixed(eyes(png(96, 80))),
        "damaged or cut short",
        "decoding",
    ),
    "poses that are not numbers": Hostile("clip.zip", fixed(endonerf(poses_with_nan())), "NaN", "decoding"),
    "poses that run code": Hostile("clip.zip", fixed(endonerf(npy([{}], allow_pickle=True))), "Python objects|object"),
    "poses with a giant header": Hostile(
        "clip.zip", fixed(endonerf(b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 30))), "not an array|not a readable"
    ),
    "poses with a giant shape": Hostile(
        "clip.zip",
        fixed(endonerf(npy(np.zeros((10, 17))).replace(b"(10, 17)", b"(1<<40)".ljust(8)))),
        "not a readable",
        "decoding",
    ),
    "entities": Hostile("calibration.xml", fixed(_ENTITIES), "XML", part="calibration"),
    "code": Hostile(
        "calibration.yaml",
        fixed(b"%YAML:1.0\n---\nM1: !!python/object/apply:os.system [id]\n"),
        "names code",
        part="calibration",
    ),
    "bytes": Hostile("calibration.yaml", fixed(bytes(range(256)) * 9), "not a text", part="calibration"),
    "deep": Hostile("calibration.json", fixed(b'{"a":' + b"[" * 99_999), "nested 100000 levels", part="calibration"),
    "deep YAML": Hostile(
        "calibration.yaml",
        fixed(b"%YAML:1.0\n---\nM1: " + b"{a: " * 49_999),
        "nested 49999 levels",
        part="calibration",
    ),
    "deep behind keys": Hostile("calibration.json", fixed(b'{"a}":' * 20_000), "not valid JSON", part="calibration"),
    "deep behind comments": Hostile(
        "calibration.xml",
        fixed(_CUT_XML + b"<a><!--</-->" * 9_000 + b"</a><!--<-->" * 9_000 + b"</opencv_storage>"),
        "has 1 number,",
        "decoding",
        "calibration",
    ),
    "not a number": Hostile("calibration.json", fixed(calibration(fx_px="NaN")), "finite number", part="calibration"),
    "beyond all numbers": Hostile(
        "calibration.json", fixed(calibration(baseline_mm="1e999")), "finite number", part="calibration"
    ),
    "in metres": Hostile(
        "calibration.json", fixed(calibration(baseline_mm="0.004")), "probably in metres", part="calibration"
    ),
    "no width": Hostile("calibration.json", fixed(calibration(width="0")), "width", part="calibration"),
    "ten times the size": Hostile(
        "calibration.json",
        fixed(calibration(width="960", height="800")),
        "more than 8 times apart",
        "decoding",
        "calibration",
    ),
    "a million times the size": Hostile(
        "calibration.json",
        fixed(calibration(width="96000000", height="80000000")),
        "more than 8 times apart",
        "decoding",
        "calibration",
    ),
    "of a cropped picture": Hostile(
        "calibration.json", fixed(calibration(width="120")), "not one uniform scale", "decoding", "calibration"
    ),
    "broken JSON": Hostile("calibration.json", fixed(CALIBRATION[:-9]), "not valid JSON", part="calibration"),
    "no camera": Hostile(
        "calibration.yaml", fixed(b"%YAML:1.0\n---\nK: 1\n"), "found no M1, M2, R, T", part="calibration"
    ),
    "cut YAML": Hostile("calibration.yml", fixed(OPENCV[:-3]), "cut short|neither JSON", part="calibration"),
    "cut XML": Hostile("calibration.xml", fixed(_CUT_XML), "cut short|neither JSON", part="calibration"),
    "half an ini": Hostile("calibration.ini", fixed(b"[StereoLeft]\nres_x=96\n"), "the ini lacks", part="calibration"),
    "large": Hostile("calibration.json", fixed(b"{" + b" " * 2_000_000 + b"}"), "2000002", part="calibration"),
    "masks of another size": Hostile(
        "masks.zip", fixed(zipped(*((f"{i}.png", png(16, 9000)) for i in range(12)))), "pixels", "decoding", "masks"
    ),
}
