"""A decoder that runs out of its memory inside a library says so, too."""

from __future__ import annotations

import json
import struct
import sys
import zlib
from pathlib import Path

import pytest

from intrasplat.clip import ClipLimits
from intrasplat.decode import StereoRecording, decode_clip, decoding
from intrasplat.errors import LimitError


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit of memory is Linux's")
def test_a_picture_that_opencv_finds_no_memory_for_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding, "memory_bytes", lambda: 3 << 29)
    folder = tmp_path / "frames"
    for eye in ("left", "right"):
        (folder / eye).mkdir(parents=True)
        (folder / eye / "000000.png").write_bytes(png_of_zeros(24_000, 16_000))
    calibration = tmp_path / "calibration.json"
    sizes = {"width": 24_000, "height": 16_000, "fx_px": 2e4, "fy_px": 2e4, "cx_px": 1.2e4, "cy_px": 8e3}
    calibration.write_text(json.dumps({"model": "rectified", **sizes, "baseline_mm": 4.0}))

    def decode() -> None:
        recording = decode_clip(folder, calibration=calibration, limits=ClipLimits(pixels_per_frame=1 << 30))
        assert isinstance(recording, StereoRecording)
        list(recording.clip.pairs())

    with pytest.raises(LimitError, match=r"needed more than 1\.0 GiB of memory"):
        decode()


def png_of_zeros(width: int, height: int) -> bytes:
    """An RGB picture that ends after its first row."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1 + 3 * width))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
