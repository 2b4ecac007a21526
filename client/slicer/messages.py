"""Encodes and decodes OpenIGTLink messages with pyigtl: pictures, transforms, texts and coloured surfaces.

Every message has the name of a device, at most 20 characters, which is the name of Slicer's node.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyigtl.messages import (
    CRC64,
    ImageMessage,
    MessageBase,
    PolyDataMessage,
    StringMessage,
    TransformMessage,
)

from client.slicer.frames import Matrix, points_in_ras
from client.slicer.surface import SurfaceMesh

PICTURE, DEPTH, SURFACE = "IntrasplatPicture", "IntrasplatDepth", "IntrasplatSurface"
CAMERA, STATUS = "IntrasplatCamera", "IntrasplatStatus"
"""The devices that the bridge sends."""
POSE, COMMAND = "IntrasplatPose", "IntrasplatCommand"
"""The devices that the bridge receives: a TRANSFORM and a STRING."""

HEADER_BYTES = MessageBase.IGTL_HEADER_SIZE
CRC_AT = 50
"""Offset of the body's checksum in the header: its last 8 bytes."""
VERSIONS = (1, 2)
MAX_TEXT = 8_000
"""Maximum characters of a text; the format allows 65,535 bytes."""

ATTRIBUTES_AT = 36
"""Offset of the number of attributes in the body of POLYDATA."""
POINT_SCALARS = 0
COLOURS_NAME = b"RGB\0"

HEARD = ("TRANSFORM", "STRING")


class DamagedError(Exception):
    """A peer's message is not OpenIGTLink, or was damaged in transit."""


@dataclass(frozen=True)
class Header:
    """The first HEADER_BYTES of a message, decoded; `fields` are pyigtl's."""

    kind: str
    body_bytes: int
    crc: int
    fields: dict[str, object]


@dataclass(frozen=True)
class Heard:
    """A message from a peer: a transform [4, 4] in Slicer's frame, or a text."""

    device: str
    matrix: Matrix | None = None
    text: str | None = None


class _ColouredPolyData(PolyDataMessage):  # type: ignore[misc]
    """POLYDATA with three scalars of 0 to 1 at each point, which pyigtl does not write."""

    def __init__(self, name: str, surface: SurfaceMesh) -> None:
        count = np.full((len(surface.faces), 1), 3, np.int32)
        polygons = np.concatenate([count, surface.faces], axis=1).ravel()
        super().__init__(points=points_in_ras(surface.vertices_mm), polygons=polygons, device_name=name)
        self._colours = surface.colours

    def _pack_content(self) -> bytes:
        plain: bytes = super()._pack_content()
        one = struct.pack(">I", 1)
        about = struct.pack(">BBI", POINT_SCALARS, 3, len(self._colours)) + COLOURS_NAME
        values = (self._colours / np.float32(255)).astype(">f4").tobytes()
        return b"".join([plain[:ATTRIBUTES_AT], one, plain[ATTRIBUTES_AT + len(one) :], about, values])


def image(name: str, values: NDArray[np.generic], ras_from_ijk: Matrix) -> bytes:
    """IMAGE of one slice: values [H, W] or [H, W, 3], row by row from the top."""
    return _packed(ImageMessage(values[None], ras_from_ijk, world_coordinate_system="ras", device_name=name))


def transform(name: str, matrix: Matrix) -> bytes:
    """TRANSFORM of a rigid motion [4, 4] in Slicer's frame."""
    return _packed(TransformMessage(matrix, device_name=name))


def text(name: str, words: str) -> bytes:
    """STRING; characters outside ASCII, which not every receiver reads, become question marks."""
    return _packed(StringMessage(words[:MAX_TEXT].encode("ascii", "replace").decode(), device_name=name))


def surface(name: str, mesh: SurfaceMesh) -> bytes:
    """POLYDATA of triangles in RAS, with the colours as point scalars RGB."""
    return _packed(_ColouredPolyData(name, mesh))


def read_header(content: bytes) -> Header:
    """Decode a header.

    Raises:
        DamagedError: it is not a header.
    """
    try:
        fields = MessageBase.parse_header(content)
        crc = int.from_bytes(content[CRC_AT:HEADER_BYTES], "big")
        header = Header(fields["message_type"], int(fields["body_size"]), crc, fields)
    except (struct.error, ValueError) as error:
        raise DamagedError("it sent what is not OpenIGTLink") from error
    if fields["header_version"] not in VERSIONS:
        raise DamagedError("it sent what is not OpenIGTLink")
    return header


def read(header: Header, body: bytes) -> Heard:
    """Decode a message of a kind in HEARD.

    Raises:
        DamagedError: it is damaged.
    """
    if CRC64(body) != header.crc:
        raise DamagedError(f"it sent a damaged {header.kind}")
    message = MessageBase.create_message(header.kind)
    try:
        message.unpack(header.fields, body)
    except Exception as error:  # pyigtl raises many types
        raise DamagedError(f"it sent a damaged {header.kind}") from error
    if header.kind == "TRANSFORM":
        return Heard(message.device_name, matrix=np.asarray(message.matrix, np.float64))
    return Heard(message.device_name, text=str(message.string))


def _packed(message: MessageBase) -> bytes:
    packed: bytes = message.pack()
    return packed
