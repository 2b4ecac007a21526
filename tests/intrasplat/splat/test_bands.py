"""A picture that is blended band by band has the bits of one that is blended at once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu import Rasterizer
from intrasplat.splat.cpu.bins import TILE_ROWS
from intrasplat.splat.cpu.model import MAX_CACHED_SIZES, CpuModel
from intrasplat.splat.model import BAND_PIXELS, bands_of
from intrasplat.splat.step import camera_vector
from tests.intrasplat.splat.scenes import random_scene
from tests.intrasplat.splat.test_cpu import moving_gaussians, project_with

LARGE = (1100, 1500)


def resized(camera: Camera, width: int, height: int) -> Camera:
    across, down = width / camera.width, height / camera.height
    lens = {"fx": camera.fx * across, "fy": camera.fy * down, "cx": camera.cx * across, "cy": camera.cy * down}
    return dataclasses.replace(camera, width=width, height=height, **lens)


@pytest.mark.parametrize("size", [(8, 8), (640, 512), (4096, 2160), (8192, 8192), (1 << 20, 3), (100, 20_000)])
@pytest.mark.parametrize("multiple", [1, TILE_ROWS])
def test_bands_hold_every_row_once_and_begin_at_whole_tiles(size: tuple[int, int], multiple: int) -> None:
    width, height = size
    bands = bands_of(width, height, multiple)
    assert [row for band in bands for row in range(band.start, band.stop)] == list(range(height))
    assert all(band.start % multiple == 0 for band in bands)
    most = max(band.stop - band.start for band in bands) * width
    assert most <= max(BAND_PIXELS, width * multiple)


def test_rows_of_tiles_in_any_order_have_the_bits_of_the_whole_picture() -> None:
    height = 3 * TILE_ROWS + 7
    scene = random_scene(300, width=45, height=height, seed=3).to(torch.float32)
    values = np.random.default_rng(0).uniform(size=300).astype(np.float32)
    rasterizer = Rasterizer(45, height)
    project_with(rasterizer, scene)
    whole = rasterizer.render(values).copy()
    project_with(rasterizer, scene)
    rasterizer.set_values(values)
    rasterizer.image[:] = np.nan
    for first in (3, 0, 2, 1):
        rows = rasterizer.render_rows(first, first + 1)
        assert np.array_equal(rows, whole[:, first * TILE_ROWS : (first + 1) * TILE_ROWS])
    assert np.array_equal(rasterizer.render_rows(1, 4), whole[:, TILE_ROWS:])


@pytest.mark.parametrize("with_values", [False, True])
def test_pictures_that_are_blended_in_turn_have_the_bits_of_renders(with_values: bool) -> None:
    gaussians, deformation, camera = moving_gaussians("shared with colour", 0)
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    values = np.random.default_rng(0).uniform(size=model.count).astype(np.float32) if with_values else None
    large = camera_vector(resized(camera, *LARGE))
    expected = [model.render(large, t, values).copy() for t in (0.2, 0.7)]
    pictures = [model.projected(large, t, values) for t in (0.2, 0.7)]
    assert len(pictures[0].bands) > 2
    for picture in pictures:
        picture.sort()
    for rows in pictures[0].bands:
        for picture, image in zip(pictures, expected, strict=True):
            assert np.array_equal(picture.blend(rows), image[:, rows])
        model.render(large, 0.5)
        model.render(camera_vector(camera), 0.9)
    for picture in pictures:
        picture.close()
    assert np.array_equal(model.render(large, 0.2, values), expected[0])


def test_buffers_are_used_again_and_those_of_few_sizes_are_kept() -> None:
    gaussians, deformation, camera = moving_gaussians("shared with colour", 0)
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    first = model.projected(camera_vector(camera), 0.5)
    first.close()
    buffers = model.rasterizer
    second = model.projected(camera_vector(camera), 0.5)
    assert model.rasterizer is buffers
    second.close()
    for width in range(20, 20 + 2 * MAX_CACHED_SIZES):
        model.projected(camera_vector(resized(camera, width, 16)), 0.5).close()
    model.projected(camera_vector(camera), 0.5).close()
    assert model.rasterizer is not buffers
