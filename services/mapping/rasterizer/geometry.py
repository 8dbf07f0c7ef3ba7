"""The part of the projection that forward and backward share, 8 Gaussians at a time.

EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023, Sec. 4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from services.mapping.rasterizer.memory import load
from services.mapping.rasterizer.simd import inlined, maximum, minimum, square_root
from services.mapping.rasterizer.vectors import (
    combined,
    dot,
    product,
    rotation_columns,
)

# Rows of 8 lanes in the scratch array of a block: mean, scale, quaternion, opacity.
_SCALE_ROW, _QUAT_ROW, OPACITY_ROW = 3, 6, 10
BLOCK_ROWS = 11


class Block(NamedTuple):
    """8 Gaussians; every number is a vector of lanes."""

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


@inlined
def gather_lane(splats, i, l, lanes):
    """Put Gaussian `i` into lane `l`."""
    means, scales, quats, opacities, _ = splats
    for k in range(3):
        lanes[k * 8 + l] = means[i * 3 + k]
        lanes[(_SCALE_ROW + k) * 8 + l] = scales[i * 3 + k]
    for k in range(4):
        lanes[(_QUAT_ROW + k) * 8 + l] = quats[i * 4 + k]
    lanes[OPACITY_ROW * 8 + l] = opacities[i]


@inlined
def load_three(lanes, row):
    """Three rows of lanes."""
    return load(lanes, row * 8), load(lanes, row * 8 + 8), load(lanes, row * 8 + 16)


@inlined
def load_block(lanes):
    """The gathered Gaussians as vectors."""
    w = load(lanes, _QUAT_ROW * 8)
    x, y, z = load_three(lanes, _QUAT_ROW + 1)
    quat_scale = 1.0 / square_root(w * w + x * x + y * y + z * z)
    quat = (w * quat_scale, x * quat_scale, y * quat_scale, z * quat_scale)
    opacity = load(lanes, OPACITY_ROW * 8)
    return Block(load_three(lanes, 0), load_three(lanes, _SCALE_ROW), quat, quat_scale, opacity)


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
    """Means and covariances on the screen."""
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
