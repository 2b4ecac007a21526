"""Encoded layers: the exact formats read back as what was rendered, and unseen pixels are marked."""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from contract.wire.rendering import ImageFormat, Layer, Unseen
from worker.render.encode import DEFAULT_QUALITY, encode_layer
from worker.render.unseen import DARK_GREY, LIGHT_GREY

HEIGHT, WIDTH = 12, 17


@dataclass(frozen=True)
class Images:
    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    confidence: NDArray[np.float32]
    unseen: NDArray[np.bool_]


@pytest.fixture
def images() -> Images:
    random = np.random.default_rng(0)
    depth_mm = random.uniform(40, 90, (HEIGHT, WIDTH)).astype(np.float32)
    depth_mm[:3] = 0
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    unseen = np.zeros((HEIGHT, WIDTH), np.bool_)
    unseen[4:, 5:] = True
    return Images(rgb, depth_mm, random.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32), unseen)


def guessed(images: Images, layer: Layer, image_format: ImageFormat = ImageFormat.PNG) -> bytes:
    return encode_layer(images, layer, image_format, unseen=Unseen.GUESS)


def decoded(data: bytes) -> NDArray[np.uint8] | NDArray[np.uint16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype in (np.uint8, np.uint16)
    return np.asarray(image)


def test_a_png_of_the_colours_is_exact(images: Images) -> None:
    image = decoded(guessed(images, Layer.RGB))
    np.testing.assert_array_equal(image[..., ::-1], images.rgb)


def test_a_png_of_depth_holds_hundredths_of_a_millimetre_and_zero_where_invalid(images: Images) -> None:
    image = decoded(guessed(images, Layer.DEPTH))
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image / 100.0, images.depth_mm.astype(float), atol=0.0051)
    assert not image[:3].any()


def test_a_png_of_confidence_is_in_255ths(images: Images) -> None:
    image = decoded(guessed(images, Layer.CONFIDENCE))
    np.testing.assert_allclose(image / 255.0, images.confidence.astype(float), atol=0.51 / 255)


@pytest.mark.parametrize(
    ("layer", "name"), [(Layer.RGB, "rgb"), (Layer.DEPTH, "depth_mm"), (Layer.CONFIDENCE, "confidence")]
)
def test_npy_is_the_array_itself(images: Images, layer: Layer, name: str) -> None:
    values = np.load(io.BytesIO(guessed(images, layer, ImageFormat.NPY)), allow_pickle=False)
    np.testing.assert_array_equal(values, getattr(images, name))


@pytest.mark.parametrize("layer", list(Layer))
@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_what_is_for_eyes_is_a_colour_picture_of_its_size(
    images: Images, layer: Layer, image_format: ImageFormat
) -> None:
    assert decoded(guessed(images, layer, image_format)).shape == (HEIGHT, WIDTH, 3)


def test_a_png_shows_a_hatch_of_two_dark_greys_under_alpha_0_where_nothing_was_seen(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.RGB, ImageFormat.PNG))
    np.testing.assert_array_equal(image[..., 3], np.where(images.unseen, 0, 255))
    np.testing.assert_array_equal(image[~images.unseen][:, 2::-1], images.rgb[~images.unseen])
    hatch = image[images.unseen][:, :3]
    assert (hatch == hatch[:, :1]).all()
    assert len(np.unique(hatch)) == 2
    assert hatch.min() > 20
    assert hatch.max() < 100


def test_a_webp_is_transparent_where_nothing_was_seen(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.RGB, ImageFormat.WEBP))
    np.testing.assert_array_equal(image[..., 3], np.where(images.unseen, 1, 255))


@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
@pytest.mark.parametrize("quality", [30, 50, DEFAULT_QUALITY, 100])
def test_the_hatch_outlives_the_encoder(image_format: ImageFormat, quality: int) -> None:
    height, width = 240, 320
    unseen = np.zeros((height, width), np.bool_)
    unseen[40:200, 60:260] = True
    rgb = np.random.default_rng(0).normal((170, 80, 70), 8, (height, width, 3)).clip(0, 255).astype(np.uint8)
    image = Images(rgb, np.ones((height, width), np.float32), np.ones((height, width), np.float32), unseen)
    shown = decoded(encode_layer(image, Layer.RGB, image_format, quality))[..., :3].mean(axis=-1)
    inner = cv2.erode(unseen.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0  # the encoder mixes neighbours
    light = decoded(encode_layer(image, Layer.RGB, ImageFormat.PNG))[..., 0] == LIGHT_GREY
    assert shown[inner & light].mean() - shown[inner & ~light].mean() > 0.5 * (LIGHT_GREY - DARK_GREY)
    assert np.corrcoef(shown[inner], light[inner])[0, 1] > 0.75


def test_a_jpeg_of_what_was_not_seen_is_dark_and_without_colour(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.RGB, ImageFormat.JPEG, 100)).astype(int)
    assert image.shape == (HEIGHT, WIDTH, 3)
    inside = image[6:, 8:]  # the encoder mixes the colours of neighbours
    assert np.ptp(inside, axis=-1).max() < 40
    assert 30 < inside.mean() < 80


@pytest.mark.parametrize(("layer", "name"), [(Layer.DEPTH, "depth_mm"), (Layer.CONFIDENCE, "confidence")])
def test_depth_and_confidence_are_0_where_nothing_was_seen(images: Images, layer: Layer, name: str) -> None:
    values = np.load(io.BytesIO(encode_layer(images, layer, ImageFormat.NPY)), allow_pickle=False)
    np.testing.assert_array_equal(values, np.where(images.unseen, 0, getattr(images, name)))
    assert not decoded(encode_layer(images, layer, ImageFormat.PNG))[images.unseen].any()


@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_quality_is_paid_for_in_bytes(images: Images, image_format: ImageFormat) -> None:
    sizes = [len(encode_layer(images, Layer.RGB, image_format, quality)) for quality in (1, 50, 100)]
    assert sizes == sorted(set(sizes))


def test_a_webp_begins_as_one(images: Images) -> None:
    encoded = encode_layer(images, Layer.RGB, ImageFormat.WEBP)
    assert (encoded[:4], encoded[8:12]) == (b"RIFF", b"WEBP")


def test_depth_beyond_the_range_of_a_png_is_held_at_its_end(images: Images) -> None:
    far = Images(images.rgb, np.full_like(images.depth_mm, 1000.0), images.confidence, images.unseen)
    assert (decoded(guessed(far, Layer.DEPTH)) == 65535).all()


def test_depth_that_is_invalid_everywhere_is_a_black_picture(images: Images) -> None:
    blind = Images(images.rgb, np.zeros_like(images.depth_mm), images.confidence, images.unseen)
    assert not decoded(encode_layer(blind, Layer.DEPTH, ImageFormat.JPEG)).any()
