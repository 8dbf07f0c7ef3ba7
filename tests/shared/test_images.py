"""Images to arrays and back, and what is no image."""

import zlib

import cv2
import numpy as np
import pytest

from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage
from shared.images import (
    decode_colour,
    decode_depth,
    encode_depth,
    encode_jpeg,
    encode_png,
)

SIZE = Intrinsics(60.0, 60.0, 15.5, 11.5, 32, 24)
CALIBRATION = Calibration(Camera(SIZE), depth_scale=1000.0, max_depth_m=10.0)
RGB = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
DEPTH = np.random.default_rng(1).integers(1, 9000, (24, 32), np.uint16)


def test_red_stays_red_through_jpeg():
    red = np.zeros((24, 32, 3), np.uint8)
    red[..., 0] = 200

    decoded = decode_colour(encode_jpeg(red, 95), SIZE)

    assert np.abs(decoded.astype(int) - red).max() <= 3


def test_png_and_raw_colour_are_exact():
    png = decode_colour(ColourImage(ColourEncoding.PNG, encode_png(RGB)), SIZE)
    raw = decode_colour(ColourImage(ColourEncoding.RGB8, RGB.tobytes()), SIZE)

    np.testing.assert_array_equal(png, RGB)
    np.testing.assert_array_equal(raw, RGB)


def test_a_grey_image_becomes_three_equal_channels():
    grey = ColourImage(ColourEncoding.PNG, encode_png(RGB[..., 0]))

    np.testing.assert_array_equal(decode_colour(grey, SIZE), np.repeat(RGB[..., :1], 3, axis=2))


@pytest.mark.parametrize("encoding", list(DepthEncoding))
def test_depth_is_metres_in_every_encoding(encoding):
    depth_m = decode_depth(encode_depth(DEPTH, encoding), CALIBRATION)

    np.testing.assert_allclose(depth_m, DEPTH / 1000.0, rtol=1e-6)


@pytest.mark.parametrize("raw", [0, 65535, 10_001])
def test_no_reading_and_beyond_the_range_are_zero(raw):
    depth = np.full((24, 32), raw, np.uint16)

    assert not decode_depth(encode_depth(depth, DepthEncoding.RAW16), CALIBRATION).any()


def jpeg(data):
    return ColourImage(ColourEncoding.JPEG, data)


JPEG = encode_jpeg(RGB).bytes


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (jpeg(JPEG[:-100]), "truncated"),
        (jpeg(b"text"), "does not start"),
        (jpeg(b"\xff\xd8\xff\xd9"), "do not decode"),
        (ColourImage(ColourEncoding.PNG, b""), "do not decode"),
        (ColourImage(ColourEncoding.PNG, encode_png(DEPTH)), "8 bit"),
        (ColourImage(ColourEncoding.PNG, encode_png(RGB[:20])), "32x20"),
        (ColourImage(ColourEncoding.RGB8, b"123"), "2304 bytes"),
    ],
)
def test_a_colour_image_that_is_none_is_refused(image, reason):
    with pytest.raises(InputError, match=reason) as caught:
        decode_colour(image, SIZE)

    assert caught.value.field == "rgb.bytes"


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (DepthImage(DepthEncoding.PNG16, encode_png(DEPTH.astype(np.uint8))), "16 bit"),
        (DepthImage(DepthEncoding.PNG16, encode_png(DEPTH)[:200]), "."),
        (DepthImage(DepthEncoding.PNG16, encode_png(DEPTH[:20])), "32x20"),
        (DepthImage(DepthEncoding.RAW16, b"123"), "1536 bytes"),
        (DepthImage(DepthEncoding.ZLIB16, b"123"), "no zlib"),
        (DepthImage(DepthEncoding.ZLIB16, zlib.compress(bytes(100))), "1536 bytes"),
        (DepthImage(DepthEncoding.ZLIB16, zlib.compress(bytes(1 << 26))), "1536 bytes"),
    ],
)
def test_a_depth_image_that_is_none_is_refused(image, reason):
    with pytest.raises(InputError, match=reason) as caught:
        decode_depth(image, CALIBRATION)

    assert caught.value.field == "depth.bytes"


def test_an_encoded_depth_png_has_sixteen_bits():
    decoded = cv2.imdecode(np.frombuffer(encode_png(DEPTH), np.uint8), cv2.IMREAD_UNCHANGED)

    np.testing.assert_array_equal(decoded, DEPTH)
