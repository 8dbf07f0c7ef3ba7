"""Encoded images to arrays and back; refuses what is damaged with the field's name."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration, Intrinsics
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage

NO_DEPTH = 65535


def decode_colour(image: ColourImage, size: Intrinsics) -> NDArray[np.uint8]:
    """The colour image, RGB, [H, W, 3].

    Raises:
        InputError: damaged, not 8 bit, or of another size than the calibration's.
    """
    if image.encoding is ColourEncoding.RGB8:
        return _rows(image.bytes, "rgb.bytes", np.uint8, (size.height, size.width, 3))
    if image.encoding is ColourEncoding.JPEG:
        _check_jpeg_end(image.bytes)
    decoded = _decode(image.bytes, cv2.IMREAD_UNCHANGED, "rgb.bytes")
    if decoded.dtype != np.uint8 or decoded.ndim not in (2, 3):
        raise InputError("rgb.bytes", f"must be 8 bit colour, got {decoded.dtype}")
    _check_size(decoded, size, "rgb.bytes")
    if decoded.ndim == 2:
        return cv2.cvtColor(decoded, cv2.COLOR_GRAY2RGB).astype(np.uint8)
    order = cv2.COLOR_BGRA2RGB if decoded.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(decoded, order).astype(np.uint8, copy=False)


def decode_depth(image: DepthImage, calibration: Calibration) -> NDArray[np.float32]:
    """The depth image in metres along the optical axis, [H, W]; 0 where there is no reading.

    Raises:
        InputError: damaged, not 16 bit, or of another size than the depth camera's.
    """
    size = calibration.depth_camera().intrinsics
    shape = (size.height, size.width)
    if image.encoding is DepthEncoding.PNG16:
        raw = _decode(image.bytes, cv2.IMREAD_UNCHANGED, "depth.bytes")
        if raw.dtype != np.uint16 or raw.ndim != 2:
            found = f"{raw.dtype} with {raw.ndim} axes"
            raise InputError("depth.bytes", f"must be a 16 bit grey PNG, got {found}")
        _check_size(raw, size, "depth.bytes")
    elif image.encoding is DepthEncoding.ZLIB16:
        raw = _rows(_inflate(image.bytes, 2 * shape[0] * shape[1]), "depth.bytes", np.uint16, shape)
    else:
        raw = _rows(image.bytes, "depth.bytes", np.uint16, shape)
    depth_m = np.multiply(raw, np.float32(1.0 / calibration.depth_scale), dtype=np.float32)
    depth_m[raw > min(calibration.max_depth_m * calibration.depth_scale, NO_DEPTH - 1)] = 0.0
    return depth_m


def encode_jpeg(rgb: NDArray[np.uint8], quality: int = 90) -> ColourImage:
    """An RGB image as JPEG."""
    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return ColourImage(ColourEncoding.JPEG, data.tobytes())


def encode_png(image: NDArray) -> bytes:
    """A uint8 RGB, uint8 grey or uint16 grey image as a fast PNG."""
    swapped = image[..., ::-1] if image.ndim == 3 else image
    _, data = cv2.imencode(".png", swapped, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return data.tobytes()


def encode_depth(depth_raw: NDArray[np.uint16], encoding: DepthEncoding) -> DepthImage:
    """A raw uint16 depth image in the given encoding."""
    if encoding is DepthEncoding.PNG16:
        return DepthImage(encoding, encode_png(depth_raw))
    rows = np.ascontiguousarray(depth_raw, "<u2").tobytes()
    return DepthImage(
        encoding, zlib.compress(rows, 1) if encoding is DepthEncoding.ZLIB16 else rows
    )


def _decode(data: bytes, flags: int, field: str) -> NDArray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(field, f"{len(data)} bytes that do not decode as an image")
    return image


def _check_jpeg_end(data: bytes) -> None:
    # libjpeg fills a truncated picture with grey and only warns, so look for the end ourselves.
    if data[:2] != b"\xff\xd8":
        raise InputError("rgb.bytes", "does not start as a JPEG")
    if b"\xff\xd9" not in data[-64:]:
        raise InputError("rgb.bytes", f"a truncated JPEG ({len(data)} bytes, no end marker)")


def _check_size(image: NDArray, size: Intrinsics, field: str) -> None:
    height, width = image.shape[:2]
    if (height, width) != (size.height, size.width):
        raise InputError(
            field, f"is {width}x{height}, the calibration says {size.width}x{size.height}"
        )


def _rows(data: bytes, field: str, dtype: type, shape: tuple[int, ...]) -> NDArray:
    expected = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if len(data) != expected:
        raise InputError(field, f"must be {expected} bytes for {shape}, got {len(data)}")
    return np.frombuffer(data, np.dtype(dtype).newbyteorder("<")).reshape(shape)


def _inflate(data: bytes, expected: int) -> bytes:
    inflater = zlib.decompressobj()
    try:
        rows = inflater.decompress(data, expected + 1)
    except zlib.error as error:
        raise InputError("depth.bytes", f"is no zlib stream ({error})") from None
    return rows
