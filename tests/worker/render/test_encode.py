"""Encoded layers: the exact formats read back as what was rendered."""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from contract.wire.rendering import ImageFormat, Layer
from worker.render.encode import encode_layer

HEIGHT, WIDTH = 12, 17


@dataclass(frozen=True)
class Images:
    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    confidence: NDArray[np.float32]


@pytest.fixture
def images() -> Images:
    random = np.random.default_rng(0)
    depth_mm = random.uniform(40, 90, (HEIGHT, WIDTH)).astype(np.float32)
    depth_mm[:3] = 0
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return Images(rgb, depth_mm, random.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32))


def decoded(data: bytes) -> NDArray[np.uint8] | NDArray[np.uint16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype in (np.uint8, np.uint16)
    return np.asarray(image)


def test_a_png_of_the_colours_is_exact(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.RGB, ImageFormat.PNG))
    np.testing.assert_array_equal(image[..., ::-1], images.rgb)


def test_a_png_of_depth_holds_hundredths_of_a_millimetre_and_zero_where_invalid(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.DEPTH, ImageFormat.PNG))
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image / 100.0, images.depth_mm.astype(float), atol=0.0051)
    assert not image[:3].any()


def test_a_png_of_confidence_is_in_255ths(images: Images) -> None:
    image = decoded(encode_layer(images, Layer.CONFIDENCE, ImageFormat.PNG))
    np.testing.assert_allclose(image / 255.0, images.confidence.astype(float), atol=0.51 / 255)


@pytest.mark.parametrize(
    ("layer", "name"), [(Layer.RGB, "rgb"), (Layer.DEPTH, "depth_mm"), (Layer.CONFIDENCE, "confidence")]
)
def test_npy_is_the_array_itself(images: Images, layer: Layer, name: str) -> None:
    values = np.load(io.BytesIO(encode_layer(images, layer, ImageFormat.NPY)), allow_pickle=False)
    np.testing.assert_array_equal(values, getattr(images, name))


@pytest.mark.parametrize("layer", list(Layer))
@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_what_is_for_eyes_is_a_colour_picture_of_its_size(
    images: Images, layer: Layer, image_format: ImageFormat
) -> None:
    assert decoded(encode_layer(images, layer, image_format)).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("image_format", [ImageFormat.JPEG, ImageFormat.WEBP])
def test_quality_is_paid_for_in_bytes(images: Images, image_format: ImageFormat) -> None:
    sizes = [len(encode_layer(images, Layer.RGB, image_format, quality)) for quality in (1, 50, 100)]
    assert sizes == sorted(set(sizes))


def test_a_webp_begins_as_one(images: Images) -> None:
    encoded = encode_layer(images, Layer.RGB, ImageFormat.WEBP)
    assert (encoded[:4], encoded[8:12]) == (b"RIFF", b"WEBP")


def test_depth_beyond_the_range_of_a_png_is_held_at_its_end(images: Images) -> None:
    far = Images(images.rgb, np.full_like(images.depth_mm, 1000.0), images.confidence)
    assert (decoded(encode_layer(far, Layer.DEPTH, ImageFormat.PNG)) == 65535).all()


def test_depth_that_is_invalid_everywhere_is_a_black_picture(images: Images) -> None:
    blind = Images(images.rgb, np.zeros_like(images.depth_mm), images.confidence)
    assert not decoded(encode_layer(blind, Layer.DEPTH, ImageFormat.JPEG)).any()
