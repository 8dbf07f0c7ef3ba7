"""Splats as binary glTF with `KHR_gaussian_splatting`: points to those who do not know it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import BinaryIO

import numpy as np

from services.mapping.export.glb import POINTS, Attribute, Primitive, glb_bytes
from services.mapping.export.harmonics import mean_colour
from services.mapping.export.splats import Splats
from shared.errors import UnavailableError

_NAME = "KHR_gaussian_splatting"
_PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def write_gltf(file: BinaryIO, blocks: Iterable[Splats], degree: int) -> None:
    """The file, y up as glTF is; scales in metres and opacities as they are, quaternions xyzw.

    The attributes of the whole map lie in memory once: 236 bytes a Gaussian of degree 3.

    Args:
        file: at its start.
        blocks: parts of the map.
        degree: of their harmonics.

    Raises:
        UnavailableError: there is nothing to write; glTF knows no empty array.
    """
    parts = [_attributes(block.y_up(), degree) for block in blocks if len(block) > 0]
    if not parts:
        raise UnavailableError("the map has no Gaussians yet, and glTF knows no empty scene")
    attributes = {name: np.concatenate([part.pop(name) for part in parts]) for name in [*parts[0]]}
    file.write(glb_bytes(Primitive(POINTS, attributes, extensions={_NAME: _PROPERTIES})))


def _attributes(splats: Splats, degree: int) -> dict[str, Attribute]:
    """What each Gaussian has, by the names of the extension."""
    attributes: dict[str, Attribute] = {
        "POSITION": splats.means_m,
        "COLOR_0": _fallback_colours(splats),
        f"{_NAME}:ROTATION": np.roll(splats.quats_wxyz, -1, axis=1),
        f"{_NAME}:SCALE": splats.scales_m,
        f"{_NAME}:OPACITY": splats.opacities,
    }
    for d in range(degree + 1):
        for n in range(2 * d + 1):
            attributes[f"{_NAME}:SH_DEGREE_{d}_COEF_{n}"] = splats.harmonics[:, d**2 + n]
    return attributes


def _fallback_colours(splats: Splats) -> Attribute:
    """The mean over all directions, and the opacity, for viewers of plain points."""
    rgba = np.concatenate([mean_colour(splats.harmonics), splats.opacities[:, None]], axis=1)
    return np.rint(255.0 * rgba.clip(0.0, 1.0)).astype(np.uint8)
