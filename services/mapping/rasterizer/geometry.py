"""The part of the projection that forward and backward share, LANES Gaussians at a time.

EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023, Sec. 4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from services.mapping.rasterizer.kernel_types import Splats
from services.mapping.rasterizer.memory import load
from services.mapping.rasterizer.scene import DILATION_PX2
from services.mapping.rasterizer.shuffles import load_four, load_three
from services.mapping.rasterizer.simd import (
    LANES,
    allocating,
    inlined,
    maximum,
    minimum,
    square_root,
)
from services.mapping.rasterizer.vectors import (
    combined,
    cross,
    dot,
    product,
    rotation_columns,
)

_DILATION, _DILATION_SQUARED = np.float32(DILATION_PX2), np.float32(DILATION_PX2**2)
_QUARTER = np.float32(0.25)


class Block(NamedTuple):
    """LANES Gaussians; every number is a vector of lanes."""

    mean: Any
    scale: Any
    quat: Any  # normalised
    quat_scale: Any  # 1 / length of the quaternion as given
    opacity: Any


class Ellipses(NamedTuple):
    """Their projections, with what the derivative needs."""

    u: Any  # x / z in the camera
    v: Any
    z: Any
    inverse_z: Any
    jacobian: Any  # d(pixel)/d(camera): (x by x, x by z, y by y, y by z)
    rows: Any  # jacobian times rotation: two 3-vectors
    axes: Any  # columns of the Gaussians' rotation
    plain: Any  # rows times axes: two 3-vectors
    spread: Any  # `plain` times the scales; covariance = spread spread^T


class Shapes(NamedTuple):
    """Dilated covariances [[a, b], [b, c]] and the factors that whiten them, divided by 4."""

    a: Any
    b: Any
    c: Any
    e1: Any
    e2: Any


@allocating
def spare_block():
    """Room for the last Gaussians where they do not fill a vector."""
    return Splats(
        np.empty(3 * LANES, np.float32),
        np.empty(3 * LANES, np.float32),
        np.empty(4 * LANES, np.float32),
        np.empty(LANES, np.float32),
        np.empty(3 * LANES, np.float32),
    )


@inlined
def _copy_rows(source, target, first, width):
    """Copy LANES rows, or repeat the last one where the source ends."""
    last = len(source) // width - 1
    for lane in range(LANES):
        row = min(first + lane, last)
        for k in range(width):
            target[lane * width + k] = source[row * width + k]


@allocating
def whole_block(splats, spare, first):
    """Arrays that hold LANES Gaussians from `first`, and where: copies at the end of `splats`."""
    if first + LANES <= len(splats.opacities):
        return splats, first
    _copy_rows(splats.means, spare.means, first, 3)
    _copy_rows(splats.scales, spare.scales, first, 3)
    _copy_rows(splats.quats, spare.quats, first, 4)
    _copy_rows(splats.opacities, spare.opacities, first, 1)
    _copy_rows(splats.colours, spare.colours, first, 3)
    return spare, 0


@inlined
def load_block(splats, i):
    """LANES Gaussians from number `i`, as vectors."""
    return normalised(
        load_three(splats.means, i * 3),
        load_three(splats.scales, i * 3),
        load_four(splats.quats, i * 4),
        load(splats.opacities, i),
    )


@inlined
def normalised(mean, scale, quat, opacity):
    """A block from the fields as given."""
    w, x, y, z = quat
    quat_scale = 1.0 / square_root(w * w + x * x + y * y + z * z)
    unit = (w * quat_scale, x * quat_scale, y * quat_scale, z * quat_scale)
    return Block(mean, scale, unit, quat_scale, opacity)


@inlined
def rotation_rows(pose):
    """The rows of the camera's rotation, from the 12 numbers of its pose."""
    return (
        (pose[0], pose[1], pose[2]),
        (pose[4], pose[5], pose[6]),
        (pose[8], pose[9], pose[10]),
    )


@inlined
def project_block(block, camera):
    """Means, and roots of the covariances without dilation, on the screen."""
    pose, slopes = camera.pose, camera.slopes
    row_x, row_y, row_z = rotation_rows(pose)
    z = dot(block.mean, row_z) + pose[11]
    inverse_z = 1.0 / z
    u = (dot(block.mean, row_x) + pose[3]) * inverse_z
    v = (dot(block.mean, row_y) + pose[7]) * inverse_z
    jx, jy = inverse_z * camera.fx, inverse_z * camera.fy
    jxz = jx * minimum(maximum(u, slopes[0]), slopes[1]) * -1.0
    jyz = jy * minimum(maximum(v, slopes[2]), slopes[3]) * -1.0
    rows = combined(row_x, jx, row_z, jxz), combined(row_y, jy, row_z, jyz)
    axes = rotation_columns(block.quat)
    plain = _times_columns(rows[0], axes), _times_columns(rows[1], axes)
    spread = product(plain[0], block.scale), product(plain[1], block.scale)
    return Ellipses(u, v, z, inverse_z, (jx, jxz, jy, jyz), rows, axes, plain, spread)


@inlined
def _times_columns(row, columns):
    return dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])


@inlined
def shapes_of(spread):
    """The ellipses with these roots of the covariance."""
    row_x, row_y = spread
    a, b, c = dot(row_x, row_x), dot(row_x, row_y), dot(row_y, row_y)
    normal = cross(row_x, row_y)
    # a c - b^2 by Lagrange's identity: exact zero cannot come out negative for a thin ellipse.
    determinant = dot(normal, normal) + (a + c) * _DILATION + _DILATION_SQUARED
    a, c = a + _DILATION, c + _DILATION
    return Shapes(a, b, c, _QUARTER / square_root(a), square_root(a / determinant) * _QUARTER)
