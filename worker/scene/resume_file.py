"""The state of a stopped training run in one file, resume.safetensors.

Its header holds a version, the loop's state as JSON, and a SHA-256 over that state and all tensors.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from contract.store.durable import FOR_ALL, replace_file
from contract.wire.errors import SceneError
from contract.wire.names import RESUME
from worker.scene.files import dtype_name, parse_tensors, read_file

RESUME_FILE = RESUME
RESUME_VERSION = 2
"""Raised whenever the stored state changes; no version reads another's."""


def save_resume(directory: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Write a training state to directory/resume.safetensors. It replaces the earlier one without a gap.

    Args:
        tensors: of any type, for example parameters, Adam's moments and a generator's state.
        state: what JSON can hold: iteration, seconds, settings.
    """
    directory.mkdir(parents=True, exist_ok=True)
    named = {name: each.detach().cpu().contiguous() for name, each in tensors.items()}
    text = json.dumps(dict(state), sort_keys=True)
    header = {"state": text, "version": str(RESUME_VERSION), "sha256": _digest(named, text)}
    replace_file(directory / RESUME_FILE, save(named, metadata=header), FOR_ALL)


def load_resume(directory: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the state that save_resume wrote, on the CPU.

    Raises:
        SceneError: there is none, it is damaged, or another version wrote it.
    """
    path = directory / RESUME_FILE
    data = read_file(path)
    tensors = parse_tensors(data, path)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__", {})
    if header.get("version") != str(RESUME_VERSION):
        found = header.get("version")
        raise SceneError(f"{path} was written by another version ({found}; this program resumes {RESUME_VERSION}).")
    if header.get("sha256") != _digest(tensors, header.get("state", "")):
        raise SceneError(f"{path} is damaged: its contents do not match their hash.")
    state: dict[str, Any] = json.loads(header["state"])
    return tensors, state


def _digest(tensors: Mapping[str, Tensor], state: str) -> str:
    """SHA-256 over the state and every tensor's name, type, shape and bytes, in the order of names."""
    digest = hashlib.sha256(state.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {dtype_name(tensor)} {list(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
