"""Encoded layers: the exact formats read back as what was rendered, and unseen pixels are marked."""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.colours import COLOUR_TABLE
from intrasplat.picture import ImageFormat, Layer, Unseen
from intrasplat.view.encode import DEFAULT_QUALITY, encode_layer
from intrasplat.view.unseen import DARK_GREY, LIGHT_GREY

HEIGHT, WIDTH = 12, 17
RANGE_MM = (40.0, 90.0)
DARKEST, BRIGHTEST = list(COLOUR_TABLE[:3]), list(COLOUR_TABLE[-3:])


@dataclass(frozen=True)
class Images:
    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    confidence: NDArray[np.float32]
    smoke: NDArray[np.float32]
    unseen: NDArray[np.bool_]


@pytest.fixture
def images() -> Images:
    random = np.random.default_rng(0)
    depth_mm = random.uniform(40, 90, (HEIGHT, WIDTH)).astype(np.float32)
    depth_mm[:3] = 0
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    unseen = np.zeros((HEIGHT, WIDTH), np.bool_)
    unseen[4:, 5:] = True
    confidence, smoke = random.uniform(0, 1, (2, HEIGHT, WIDTH)).astype(np.float32)
    return Images(rgb, depth_mm, confidence, smoke, unseen)


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
    ("layer", "name"),
    [(Layer.RGB, "rgb"), (Layer.DEPTH, "depth_mm"), (Layer.CONFIDENCE, "confidence"), (Layer.SMOKE, "smoke")],
)
def test_npy_is_the_array_itself(images: Images, layer: Layer, name: str) -> None:
    values = np.load(io.BytesIO(guessed(images, layer, ImageFormat.NPY)), allow_pickle=False)
    np.testing.assert_array_equal(values, getattr(images, name))


@pytest.mark.parametrize("layer", list(Layer))
@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_what_is_for_eyes_is_a_colour_picture_of_its_size(
    images: Images, layer: Layer, image_format: ImageFormat
) -> None:
    content = encode_layer(
        images, layer, image_format, unseen=Unseen.GUESS, depth_range_mm=RANGE_MM, error=images.smoke
    )
    assert decoded(content).shape == (HEIGHT, WIDTH, 3)


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
    image = Images(rgb, *(np.ones((height, width), np.float32) for _ in range(3)), unseen)
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


@pytest.mark.parametrize(
    ("layer", "name"), [(Layer.DEPTH, "depth_mm"), (Layer.CONFIDENCE, "confidence"), (Layer.SMOKE, "smoke")]
)
def test_all_layers_but_colours_are_0_where_nothing_was_seen(images: Images, layer: Layer, name: str) -> None:
    values = np.load(io.BytesIO(encode_layer(images, layer, ImageFormat.NPY)), allow_pickle=False)
    np.testing.assert_array_equal(values, np.where(images.unseen, 0, getattr(images, name)))
    assert not decoded(encode_layer(images, layer, ImageFormat.PNG))[images.unseen].any()


@pytest.mark.parametrize("layer", list(Layer))
def test_what_was_not_seen_has_the_same_hatch_in_every_layer_for_eyes(images: Images, layer: Layer) -> None:
    height, width = 96, 192
    unseen = np.zeros((height, width), np.bool_)
    unseen[:, 64:] = True
    flat = Images(np.full((height, width, 3), 99, np.uint8), *(np.ones((3, height, width), np.float32)), unseen)
    error = np.where(unseen, np.float32(np.nan), np.float32(1))
    shown = decoded(encode_layer(flat, layer, ImageFormat.JPEG, 100, depth_range_mm=RANGE_MM, error=error)).astype(int)
    hatch = decoded(encode_layer(flat, Layer.RGB, ImageFormat.PNG))[..., :3].astype(int)
    np.testing.assert_allclose(shown[:, 80:], hatch[:, 80:], atol=6)  # of the encoder


@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_quality_is_paid_for_in_bytes(images: Images, image_format: ImageFormat) -> None:
    sizes = [len(encode_layer(images, Layer.RGB, image_format, quality)) for quality in (1, 50, 100)]
    assert sizes == sorted(set(sizes))


def test_a_webp_begins_as_one(images: Images) -> None:
    encoded = encode_layer(images, Layer.RGB, ImageFormat.WEBP)
    assert (encoded[:4], encoded[8:12]) == (b"RIFF", b"WEBP")


def test_depth_beyond_the_range_of_a_png_is_held_at_its_end(images: Images) -> None:
    far = Images(images.rgb, np.full_like(images.depth_mm, 1000.0), images.confidence, images.smoke, images.unseen)
    assert (decoded(guessed(far, Layer.DEPTH)) == 65535).all()


def test_depth_that_is_invalid_everywhere_is_a_black_picture(images: Images) -> None:
    blind = Images(images.rgb, np.zeros_like(images.depth_mm), images.confidence, images.smoke, images.unseen)
    encoded = encode_layer(blind, Layer.DEPTH, ImageFormat.JPEG, unseen=Unseen.GUESS, depth_range_mm=RANGE_MM)
    assert not decoded(encoded).any()


def in_false_colours(layer: Layer, value: float, depth_range_mm: tuple[float, float] | None = RANGE_MM) -> list[int]:
    """R G B of the first pixel of a picture of this value alone."""
    values = np.full((16, 16), value, np.float32)
    image = Images(np.zeros((16, 16, 3), np.uint8), values, values, values, np.zeros((16, 16), np.bool_))
    content = encode_layer(image, layer, ImageFormat.JPEG, 100, depth_range_mm=depth_range_mm)
    return [int(each) for each in decoded(content)[0, 0, ::-1]]


@pytest.mark.parametrize(
    ("layer", "value", "colour"),
    [
        (Layer.DEPTH, 40.0, BRIGHTEST),
        (Layer.DEPTH, 12.0, BRIGHTEST),
        (Layer.DEPTH, 90.0, DARKEST),
        (Layer.DEPTH, 300.0, DARKEST),
        (Layer.CONFIDENCE, 1.0, BRIGHTEST),
        (Layer.CONFIDENCE, 0.0, DARKEST),
    ],
)
def test_false_colours_are_those_of_the_table_with_near_and_high_bright(
    layer: Layer, value: float, colour: list[int]
) -> None:
    np.testing.assert_allclose(in_false_colours(layer, value), colour, atol=2)  # of the encoder


def test_one_depth_has_one_colour_whatever_else_the_picture_shows(images: Images) -> None:
    near = Images(images.rgb, np.full_like(images.depth_mm, 60.0), images.confidence, images.smoke, images.unseen)
    near.depth_mm[:, 8:] = 45.0
    shown = decoded(encode_layer(near, Layer.DEPTH, ImageFormat.WEBP, 100, Unseen.GUESS, depth_range_mm=RANGE_MM))
    np.testing.assert_allclose(shown[0, 0, 2::-1], in_false_colours(Layer.DEPTH, 60.0), atol=3)


def test_depth_in_false_colours_needs_a_range() -> None:
    with pytest.raises(ValueError, match="depth_range_mm"):
        in_false_colours(Layer.DEPTH, 60.0, None)
