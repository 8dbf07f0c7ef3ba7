"""Backward projection: gradient records of pairs to gradients of the Gaussians and the pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.rasterizer.geometry import (
    normalised,
    project_block,
    rotation_rows,
    shapes_of,
    spare_block,
    whole_block,
)
from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    DEPTH_SUM,
    MOMENT,
    MOMENT_1,
    MOMENT_2,
    MOMENT_11,
    MOMENT_12,
    MOMENT_22,
    RECORD,
)
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.shuffles import (
    load_four,
    load_records,
    load_three,
    store_four,
    store_three,
)
from services.mapping.rasterizer.simd import LANES, inlined, kernel, select, splat, square_root
from services.mapping.rasterizer.vectors import (
    combined,
    dot,
    product,
    quaternion_gradient,
    scaled,
    weighted,
)

_ZERO, _ONE, _TWO, _SIXTEEN = (np.float32(x) for x in (0.0, 1.0, 2.0, 16.0))
_WHITENING = np.float32(256.0)  # two factors E of 1/4 and two whitened offsets of 1/4


class Pairs(NamedTuple):
    """Gradient records of (Gaussian, tile) pairs, ordered by Gaussian."""

    starts: NDArray[np.int32]  # bounds of each Gaussian's slots, [N + 1]
    sums: NDArray[np.float32]  # [M * RECORD]


class Gradients(NamedTuple):
    """Gradients of the loss, flat; each Gaussian's are written exactly once.

    The arrays have room for whole vectors of Gaussians.
    """

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colours: NDArray[np.float32]
    screen: NDArray[np.float32]  # norm at the screen mean, normalised device coordinates, [N]
    poses: NDArray[np.float32]  # per chunk and lane, rows of T_camera_world, [chunks, 12 * LANES]


@kernel
def project_backward(splats, camera, pairs, gradients, counter):
    """Fill `gradients`, a chunk of Gaussians per count."""
    spare, total = spare_block(), len(splats.opacities)
    pile, seen = np.empty(LANES * RECORD, np.float32), np.empty(LANES, np.float32)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, total)
        if start >= stop:
            return
        pose = gradients.poses[chunk]
        pose[:] = _ZERO
        for base in range(start, stop, LANES):
            if _sum_pairs(pairs, base, stop, (pile, seen)):
                source, i = whole_block(splats, spare, base)
                block = _seen_block(source, i, load(seen, 0) > _ZERO, camera)
                _block_gradients(block, camera, load_records(pile, 0), (gradients, base), pose)
            else:
                _write_nothing(gradients, base)


@kernel
def add_sums(pairs, totals, counter):
    """Add the gradient records of each Gaussian over its tiles to its one record of `totals`."""
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, len(pairs.starts) - 1)
        if start >= stop:
            return
        for i in range(start, stop):
            target = np.int64(totals.starts[i]) * RECORD
            for slot in range(np.int64(pairs.starts[i]), np.int64(pairs.starts[i + 1])):
                for k in range(0, RECORD, LANES):
                    total = load(totals.sums, target + k) + load(pairs.sums, slot * RECORD + k)
                    store(totals.sums, target + k, total)


@kernel
def first_sums(pairs, sums, counter):
    """Sum the colour's and the depth's part of each Gaussian's records over its tiles, [N, 4]."""
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, len(pairs.starts) - 1)
        if start >= stop:
            return
        for i in range(start, stop):
            sums[i] = _ZERO
            for slot in range(np.int64(pairs.starts[i]), np.int64(pairs.starts[i + 1])):
                for k in range(DEPTH_SUM + 1):
                    sums[i, k] += pairs.sums[slot * RECORD + k]


@inlined
def _sum_pairs(pairs, base, stop, target):
    """Sum each Gaussian's records over its tiles; gives whether the block has any.

    `seen` notes which Gaussians do.
    """
    pile, seen = target
    starts, zero = pairs.starts, splat(_ZERO)
    for l in range(LANES):
        i = min(base + l, stop - 1)
        first, last = np.int64(starts[i]), np.int64(starts[i + 1])
        if base + l >= stop:
            first = last
        seen[l] = _ONE if first < last else _ZERO
        for k in range(0, RECORD, LANES):
            total = zero
            for slot in range(first, last):
                total = total + load(pairs.sums, slot * RECORD + k)
            store(pile, l * RECORD + k, total)
    return starts[base] < starts[min(base + LANES, stop)]


@inlined
def _seen_block(splats, i, is_seen, camera):
    """A block of Gaussians with a stand-in on the optical axis for each that no tile has seen.

    Its sums are 0, but its projection may be infinite, and 0 times infinity would be NaN.
    """
    x, y, z = load_three(splats.means, i * 3)
    scale, quat = load_three(splats.scales, i * 3), load_four(splats.quats, i * 4)
    row_x, row_y, row_z = rotation_rows(camera.pose)
    t_x, t_y, t_z = camera.pose[3], camera.pose[7], camera.pose[11] - _ONE
    mean = (
        select(is_seen, x, -(row_x[0] * t_x + row_y[0] * t_y + row_z[0] * t_z)),
        select(is_seen, y, -(row_x[1] * t_x + row_y[1] * t_y + row_z[1] * t_z)),
        select(is_seen, z, -(row_x[2] * t_x + row_y[2] * t_y + row_z[2] * t_z)),
    )
    return normalised(
        mean,
        _instead(is_seen, scale),
        (select(is_seen, quat[0], _ONE), *_instead(is_seen, (quat[1], quat[2], quat[3]))),
        select(is_seen, load(splats.opacities, i), _ONE),
    )


@inlined
def _instead(is_seen, vectors):
    """The vectors where a Gaussian is seen, else 0."""
    return (
        select(is_seen, vectors[0], _ZERO),
        select(is_seen, vectors[1], _ZERO),
        select(is_seen, vectors[2], _ZERO),
    )


@inlined
def _screen_gradients(spread, moments):
    """Gradients at the screen mean and, doubled, at the covariance, from the whitened moments.

    With L the whitening (e = L d), d(exponent) = (L^T e) . d(mean) + (L^T e)(L^T e)^T : d(cov) / 2.
    """
    a, b, _, e1, e2 = shapes_of(spread)
    m1, m2, m11, m12, m22 = moments
    slide = b / a * e2 * np.float32(-1.0)
    x, y = (e1 * m1 + slide * m2) * _SIXTEEN, e2 * m2 * _SIXTEEN
    aa = e1 * (e1 * m11 + slide * m12 * _TWO) + slide * slide * m22
    ab = e2 * (e1 * m12 + slide * m22)
    return (x, y), (aa * _WHITENING, ab * _WHITENING, e2 * e2 * m22 * _WHITENING)


@inlined
def _block_gradients(block, camera, sums, target, pose):
    """Chain rule through the covariance and the mean of LANES Gaussians."""
    gradients, i = target
    seen = project_block(block, camera)
    screen, (aa, ab, cc) = _screen_gradients(
        seen.spread,
        (sums[MOMENT_1], sums[MOMENT_2], sums[MOMENT_11], sums[MOMENT_12], sums[MOMENT_22]),
    )
    spread_x, spread_y = seen.spread
    to_spread = combined(spread_x, aa, spread_y, ab), combined(spread_x, ab, spread_y, cc)
    scales = _sum(product(to_spread[0], seen.plain[0]), product(to_spread[1], seen.plain[1]))
    to_plain = product(to_spread[0], block.scale), product(to_spread[1], block.scale)
    to_rows = weighted(seen.axes, to_plain[0]), weighted(seen.axes, to_plain[1])
    point = _camera_point_gradient(seen, camera, sums[DEPTH_SUM], screen, to_rows)
    rows = rotation_rows(camera.pose)
    store_three(gradients.means, i * 3, weighted(rows, point))
    store_three(gradients.scales, i * 3, scales)
    store_three(gradients.colours, i * 3, (sums[0], sums[1], sums[2]))
    store_four(gradients.quats, i * 4, _quat_gradient(block, seen.rows, to_plain))
    store(gradients.opacities, i, sums[MOMENT] / block.opacity)
    x, y = screen[0] * (camera.width * 0.5), screen[1] * (camera.height * 0.5)
    store(gradients.screen, i, square_root(x * x + y * y))
    _add_pose(pose, block.mean, seen.jacobian, to_rows, point)


@inlined
def _sum(u, v):
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@inlined
def _camera_point_gradient(seen, camera, to_depth, screen, to_rows):
    """Gradient at the mean in the camera, through pixel, Jacobian and rendered depth."""
    rows = rotation_rows(camera.pose)
    row_z = rows[2]
    jx, jxz, jy, jyz = seen.jacobian
    to_jx, to_jxz = dot(to_rows[0], rows[0]), dot(to_rows[0], row_z)
    to_jy, to_jyz = dot(to_rows[1], rows[1]), dot(to_rows[1], row_z)
    slopes, zero = camera.slopes, splat(_ZERO)
    # Outside the clamp, x/z no longer moves the Jacobian.
    free_x = select((seen.u >= slopes[0]) & (seen.u <= slopes[1]), to_jxz, zero)
    free_y = select((seen.v >= slopes[2]) & (seen.v <= slopes[3]), to_jyz, zero)
    x = jx * (screen[0] - free_x * seen.inverse_z)
    y = jy * (screen[1] - free_y * seen.inverse_z)
    by_pixel = screen[0] * jx * seen.u + screen[1] * jy * seen.v
    by_jacobian = to_jx * jx + to_jy * jy + (to_jxz + free_x) * jxz + (to_jyz + free_y) * jyz
    return x, y, to_depth - by_pixel - by_jacobian * seen.inverse_z


@inlined
def _quat_gradient(block, rows, to_plain):
    """Through the rotation and the normalisation of the quaternion."""
    columns = (
        combined(rows[0], to_plain[0][0], rows[1], to_plain[1][0]),
        combined(rows[0], to_plain[0][1], rows[1], to_plain[1][1]),
        combined(rows[0], to_plain[0][2], rows[1], to_plain[1][2]),
    )
    q = block.quat
    w, x, y, z = quaternion_gradient(q, columns)
    along = w * q[0] + x * q[1] + y * q[2] + z * q[3]
    return (
        (w - along * q[0]) * block.quat_scale,
        (x - along * q[1]) * block.quat_scale,
        (y - along * q[2]) * block.quat_scale,
        (z - along * q[3]) * block.quat_scale,
    )


@inlined
def _add_pose(pose, mean, jacobian, to_rows, point):
    """Add a block's gradient at the rows (rotation, translation) of the pose."""
    jx, jxz, jy, jyz = jacobian
    _add_pose_row(pose, 0, _sum(scaled(mean, point[0]), scaled(to_rows[0], jx)), point[0])
    _add_pose_row(pose, 4, _sum(scaled(mean, point[1]), scaled(to_rows[1], jy)), point[1])
    depth_row = combined(to_rows[0], jxz, to_rows[1], jyz)
    _add_pose_row(pose, 8, _sum(scaled(mean, point[2]), depth_row), point[2])


@inlined
def _add_pose_row(pose, row, rotation, translation):
    _add_to(pose, row * LANES, rotation[0])
    _add_to(pose, (row + 1) * LANES, rotation[1])
    _add_to(pose, (row + 2) * LANES, rotation[2])
    _add_to(pose, (row + 3) * LANES, translation)


@inlined
def _add_to(pose, place, lanes):
    store(pose, place, load(pose, place) + lanes)


@inlined
def _write_nothing(gradients, i):
    zero = splat(_ZERO)
    store_three(gradients.means, i * 3, (zero, zero, zero))
    store_three(gradients.scales, i * 3, (zero, zero, zero))
    store_three(gradients.colours, i * 3, (zero, zero, zero))
    store_four(gradients.quats, i * 4, (zero, zero, zero, zero))
    store(gradients.opacities, i, zero)
    store(gradients.screen, i, zero)
