"""The state of a training run in one file, resume.safetensors, from which a stopped or killed run continues.

Its header contains a version, the loop's state as JSON, and a CRC-32 of that state and all tensors.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file
from torch import Tensor

from intrasplat.errors import SceneError
from intrasplat.files.durable import FOR_ALL, flush, temporary_path
from intrasplat.names import RESUME

RESUME_FILE = RESUME
RESUME_VERSION = 5
"""It rises whenever the stored state changes; no version reads another's."""

_DTYPES = {
    torch.float32: "F32",
    torch.float64: "F64",
    torch.int32: "I32",
    torch.int64: "I64",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
_NO_CHECKSUM = "-" * 8
"""Stands in place of the checksum until the file is complete."""
_AT_ONCE_BYTES = 1 << 20
_PIECE_BYTES, _AT_MOST_BYTES = 1 << 20, 64 << 20
"""after_each is called after pieces of at least the first size; tensors larger than the second are written by rows."""


def begin_resume(
    directory: Path,
    tensors: Mapping[str, Tensor],
    state: Mapping[str, Any],
    after_each: Callable[[], None] = lambda: None,
) -> Callable[[], None]:
    """Copy a training state to the page cache; return a function that waits for the disk, on any thread.

    Until that function returns, directory/resume.safetensors is the earlier state; then it is the new one. The tensors
    may change as soon as begin_resume returns. Only one write to a directory may be in progress at a time.

    Args:
        tensors: parameters and Adam's moments, for example, of a type in _DTYPES, on any device.
        state: iteration, seconds, settings: anything that JSON can represent.
        after_each: called after each large piece, to free pages of tensors that are mapped from files.

    Raises:
        OSError: the disk is full or refuses; the earlier file is unchanged. The returned function raises it, too.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / RESUME_FILE
    temporary = temporary_path(path)
    temporary.unlink(missing_ok=True)  # left by a crash
    tensors = dict(sorted(tensors.items(), key=lambda each: -each[1].element_size()))  # so that each is aligned
    text, places = json.dumps(dict(state), sort_keys=True), _places(tensors)
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, FOR_ALL)
        with open(descriptor, "wb") as file:
            file.write(_header(places, text, _NO_CHECKSUM))
            for tensor in tensors.values():
                for piece in _pieces(tensor.detach().cpu()):
                    file.write(piece)
                    if piece.nbytes >= _PIECE_BYTES:
                        after_each()
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise

    def complete() -> None:
        try:
            start = len(_header(places, text, _NO_CHECKSUM))
            with temporary.open("r+b") as file:
                file.write(_header(places, text, _checksum(temporary, start, text)))
                file.flush()
                os.fsync(file.fileno())
            temporary.rename(path)
        finally:
            temporary.unlink(missing_ok=True)
        flush(directory)

    return complete


def load_resume(directory: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the state that begin_resume wrote, on the CPU. The tensors are mapped from the file: use them
    before it is replaced.

    Raises:
        SceneError: the file is missing or damaged, or another version wrote it.
    """
    path = directory / RESUME_FILE
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            metadata = json.loads(file.read(min(length, path.stat().st_size)))["__metadata__"]
        if metadata["version"] != str(RESUME_VERSION):
            found = metadata["version"]
            raise SceneError(f"{path} was written by another version ({found}; this program resumes {RESUME_VERSION}).")
        if metadata["crc32"] != _checksum(path, 8 + length, metadata["state"]):
            raise SceneError(f"{path} is damaged: its contents do not match their checksum.")
        return load_file(path), json.loads(metadata["state"])
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}.") from error
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{path} is damaged: {error}.") from error


def _places(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Type, shape and offsets of each tensor in the file, in safetensors' format."""
    places, end = {}, 0
    for name, tensor in tensors.items():
        start, end = end, end + tensor.numel() * tensor.element_size()
        places[name] = {"dtype": _DTYPES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [start, end]}
    return places


def _header(places: Mapping[str, Any], state: str, checksum: str) -> bytes:
    """The start of the file. Its length does not depend on the checksum, and it aligns the tensors that follow."""
    metadata = {"version": str(RESUME_VERSION), "crc32": checksum, "state": state}
    text = json.dumps({"__metadata__": metadata, **places}).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _pieces(tensor: Tensor) -> Iterator[memoryview]:
    """The bytes of a tensor in order. It is copied in parts: rows of a padded array are not contiguous."""
    small = tensor.numel() * tensor.element_size() <= _AT_MOST_BYTES
    if (tensor.is_contiguous() and small) or tensor.dim() < 2:
        yield tensor.contiguous().view(-1).view(torch.uint8).numpy().data
        return
    for row in tensor:
        yield from _pieces(row)


def _checksum(path: Path, start: int, state: str) -> str:
    """CRC-32 of the state and of the file's bytes from start on."""
    found = zlib.crc32(state.encode())
    with path.open("rb") as file:
        file.seek(start)
        while piece := file.read(_AT_ONCE_BYTES):
            found = zlib.crc32(piece, found)
    return f"{found:08x}"
