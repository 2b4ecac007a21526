"""A scene stores the patterns of motion that show, and no file asks for more bases than there is memory for."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from intrasplat.scene.compact import MAX_WEIGHTS, unpack
from tests.intrasplat.scene.test_compact import colourful, rounded


def test_patterns_that_do_not_show_are_left_out() -> None:
    scene = colourful(200)
    faint = scene.deformation.weight.clone()
    faint[..., 1:] = faint[..., :1]  # every basis moves everything as the first one does: no motion is left
    still = dataclasses.replace(scene, deformation=dataclasses.replace(scene.deformation, weight=faint))
    assert rounded(scene).pattern.shape[1] == scene.deformation.bases - 1
    assert rounded(still).pattern.shape[1] == 0
    back = unpack(rounded(still).tensors()).model()[1]
    assert back.weight.shape == faint.shape
    assert not back.weight.any()


def test_no_file_has_more_bases_than_memory_has_room_for() -> None:
    bases, stored = 10**6, rounded(colourful(50)).tensors()
    channels, patterns, _ = stored["pattern"].shape
    many = {"pattern": torch.zeros(channels, patterns, bases), "centre": torch.zeros(bases), "width": torch.ones(bases)}
    with pytest.raises(ValueError, match=f"more than {MAX_WEIGHTS} weights"):
        unpack(stored | many)
