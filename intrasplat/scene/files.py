"""Read files of tensors: the code that scene.safetensors and resume.safetensors share."""

from __future__ import annotations

from pathlib import Path

import safetensors
from safetensors.torch import load
from torch import Tensor

from intrasplat.errors import SceneError


def read_file(path: Path) -> bytes:
    """The bytes of a file; SceneError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}.") from error


def parse_tensors(data: bytes, path: Path) -> dict[str, Tensor]:
    """The tensors in the bytes of the safetensors file at path; SceneError if they are damaged."""
    try:
        return dict(load(data))
    except (safetensors.SafetensorError, ValueError, KeyError) as error:
        raise SceneError(f"{path} is damaged: {error}.") from error


def dtype_name(tensor: Tensor) -> str:
    """The name of a tensor's type, such as "float32"."""
    return str(tensor.dtype).removeprefix("torch.")
