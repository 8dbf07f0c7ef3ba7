"""Splats as the binary PLY of 3D Gaussian Splatting: what every splat viewer reads."""

from __future__ import annotations

from collections.abc import Iterable
from typing import BinaryIO

import numpy as np

from services.mapping.export.splats import Floats, Splats

_FIRST = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_LAST = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_COUNT_DIGITS = 20  # a count has at most


def write_ply(file: BinaryIO, blocks: Iterable[Splats], degree: int) -> None:
    """The file block by block, for a map has gigabytes; in its own axes, as viewers expect.

    Opacity as a logit, scales as logarithms, quaternions wxyz, coefficients of one colour after
    those of another.

    Args:
        file: at its start; its beginning is written again when the number of Gaussians is known.
        blocks: parts of the map.
        degree: of their harmonics.
    """
    count = 0
    file.write(_header(count, degree))
    for block in blocks:
        file.write(_vertices(block).tobytes())
        count += len(block)
    file.seek(0)
    file.write(_header(count, degree))


def _header(count: int, degree: int) -> bytes:
    """As long for any count."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    number = str(count)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {'-' * (_COUNT_DIGITS - len(number))}",
        f"element vertex {number}",
        *(f"property float {name}" for name in (*_FIRST, *rest, *_LAST)),
        "end_header",
        "",
    ]
    return "\n".join(header).encode()


def _vertices(splats: Splats) -> Floats:
    """One row a Gaussian, in the order of the header."""
    others = splats.harmonics[:, 1:].transpose(0, 2, 1)
    opacities = splats.opacities[:, None]
    columns: list[Floats] = [
        splats.means_m,
        np.zeros_like(splats.means_m),
        splats.harmonics[:, 0],
        others.reshape(len(splats), others.shape[1] * others.shape[2]),
        np.log(opacities / (1.0 - opacities)),
        np.log(splats.scales_m),
        splats.quats_wxyz,
    ]
    return np.concatenate(columns, axis=1).astype("<f4", copy=False)
