"""Splats as SPZ, version 3 (Niantic): quantised and gzipped, about a tenth of a PLY's bytes."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterable
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from services.mapping.export.splats import Floats, Splats

_MAGIC, _VERSION = 0x5053474E, 3
_FRACTION_BITS = 12  # positions in steps of 0.24 mm, up to 2 km
_MAX_POSITION = (1 << 23) - 1
_SMALL_BITS = 9  # of the size of a quaternion's component; a tenth bit is its sign
_COLOUR_SCALE = 0.15
_BUCKETS = {1: 8, 2: 16, 3: 16}  # harmonics of a degree are kept in steps of so many 1/128


def write_spz(file: BinaryIO, blocks: Iterable[Splats], degree: int) -> None:
    """The file, in OpenGL's axes as the format wants; attributes one after the other.

    Args:
        file: at its start.
        blocks: parts of the map.
        degree: of their harmonics.
    """
    sections = [bytearray() for _ in range(6)]
    for block in blocks:
        for section, part in zip(sections, _quantised(block.y_up()), strict=True):
            section += part.tobytes()
    count = len(sections[1])  # a byte of opacity each
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, count, degree, _FRACTION_BITS, 0, 0)
    with gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6, mtime=0) as packed:
        for part in (header, *sections):
            packed.write(part)


def _quantised(splats: Splats) -> tuple[NDArray[np.uint8], ...]:
    """The bytes of every attribute, in the order of the file."""
    return (
        _positions(splats.means_m),
        _bytes(255.0 * splats.opacities),
        _bytes(255.0 * (_COLOUR_SCALE * splats.harmonics[:, 0] + 0.5)),
        _bytes(16.0 * (np.log(splats.scales_m) + 10.0)),
        _rotations(splats.quats_wxyz),
        _harmonics(splats.harmonics[:, 1:], splats.degree),
    )


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _positions(means_m: Floats) -> NDArray[np.uint8]:
    """Three bytes a number, the lowest first."""
    fixed = np.rint(means_m.astype(np.float64) * (1 << _FRACTION_BITS))
    whole = fixed.clip(-_MAX_POSITION, _MAX_POSITION).astype("<i4")
    return whole[..., None].view(np.uint8)[..., :3]


def _rotations(quats_wxyz: Floats) -> NDArray[np.uint8]:
    """The number of the largest of x, y, z, w in the two highest bits, then the other three."""
    xyzw = np.roll(quats_wxyz, -1, axis=1)
    rows, largest = np.arange(len(xyzw)), np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[rows, largest] < 0.0, -1.0, 1.0)[:, None]  # the same rotation
    sizes = np.rint(np.abs(xyzw) * np.sqrt(2.0) * ((1 << _SMALL_BITS) - 1)).astype(np.uint32)
    codes = sizes | ((xyzw < 0.0).astype(np.uint32) << _SMALL_BITS)
    packed = largest.astype(np.uint32)
    for i in range(4):
        packed = np.where(largest == i, packed, (packed << (_SMALL_BITS + 1)) | codes[:, i])
    return packed.astype("<u4").view(np.uint8)


def _harmonics(coefficients: Floats, degree: int) -> NDArray[np.uint8]:
    """Coefficients above degree 0, [N, B, 3], red, green, blue of one after those of another."""
    steps = [np.full(2 * d + 1, _BUCKETS[d]) for d in range(1, degree + 1)]
    step = np.concatenate([np.empty(0, np.int64), *steps])[:, None]
    levels = np.rint(128.0 * coefficients).astype(np.int64) + 128
    return ((levels + step // 2) // step * step).clip(0, 255).astype(np.uint8)
