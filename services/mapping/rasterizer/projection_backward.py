"""Backward projection: gradient records of pairs to gradients of the Gaussians and the pose."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.rasterizer.geometry import (
    BLOCK_ROWS,
    gather_lane,
    load_block,
    project_block,
    rotation_rows,
)
from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    DEPTH_SUM,
    E1,
    E2,
    MOMENT,
    MOMENT_1,
    MOMENT_2,
    MOMENT_11,
    MOMENT_12,
    MOMENT_22,
    NUM_SUMS,
    RECORD,
    SHEAR,
)
from services.mapping.rasterizer.memory import fetch_add, load, prefetch, store
from services.mapping.rasterizer.simd import inlined, kernel, select, splat
from services.mapping.rasterizer.vectors import (
    combined,
    dot,
    product,
    quaternion_gradient,
    scaled,
    weighted,
)

_ZERO, _TWO, _SIXTEEN = np.float32(0.0), np.float32(2.0), np.float32(16.0)
_WHITENING = np.float32(256.0)  # two factors E of 1/4 and two whitened offsets of 1/4

# Rows of 8 lanes: the summed gradient record, then what the records hold of the projection.
_SUM_E1, _SUM_SHEAR, _SUM_E2 = NUM_SUMS, NUM_SUMS + 1, NUM_SUMS + 2
_PILE = NUM_SUMS + 3  # before they are transposed
_SUM_ROWS = _PILE + RECORD

# Rows of 8 lanes of the gradients on their way out, and the gradient at the screen mean.
_MEAN, _SCALE, _QUAT, _OPACITY, _SCREEN, _OUT_ROWS = 0, 3, 6, 10, 11, 13


class Pairs(NamedTuple):
    """Records of Gaussians and of pairs, and the way from one to the other (see `TileLists`)."""

    records: NDArray[np.float32]
    starts: NDArray[np.int32]
    slots: NDArray[np.int32]
    ranks: NDArray[np.int32]
    sums: NDArray[np.float32]  # gradient records, ordered by tile and depth


class Gradients(NamedTuple):
    """Gradients of the loss, flat; each Gaussian's are written exactly once."""

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colours: NDArray[np.float32]
    screen: NDArray[np.float32]  # norm at the screen mean, normalised device coordinates, [N]
    poses: NDArray[np.float32]  # per chunk and lane, rows of T_camera_world, [chunks, 12 * 8]


@kernel
def project_backward(splats, camera, pairs, gradients, counter):
    """Fill `gradients`, a chunk of Gaussians per count."""
    lanes, sums = np.empty(BLOCK_ROWS * 8, np.float32), np.empty(_SUM_ROWS * 8, np.float32)
    out, total = np.empty(_OUT_ROWS * 8, np.float32), len(splats.opacities)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, total)
        if start >= stop:
            return
        pose = gradients.poses[chunk]
        pose[:] = _ZERO
        for base in range(start, stop, 8):
            count = min(8, stop - base)
            _prefetch_pairs(pairs, base + 16, min(stop, base + 24))
            seen = _sum_pairs(pairs, base, count, sums)
            if seen >= 0:
                _gather_block(splats, pairs, (base, count, seen), lanes, sums)
                _block_gradients(lanes, camera, sums, out, pose)
                _write_block(gradients, camera, (base, count), sums, out)
            else:
                _write_nothing(gradients, base, count)


@inlined
def _prefetch_pairs(pairs, first, stop):
    """The records of a Gaussian lie where its tiles put them: ask for them early."""
    for i in range(first, stop):
        slot = pairs.starts[i]
        if pairs.starts[i + 1] > slot:
            prefetch(pairs.sums, np.int64(pairs.ranks[pairs.slots[slot]]) * RECORD)


@inlined
def _sum_pairs(pairs, base, count, sums):
    """Sum each Gaussian's records over its tiles, as rows of lanes.

    Gives a Gaussian of the block that has any tile, or -1.
    """
    starts, slots, ranks = pairs.starts, pairs.slots, pairs.ranks
    seen = -1
    for l in range(count):
        low, high = splat(_ZERO), splat(_ZERO)
        for slot in range(starts[base + l], starts[base + l + 1]):
            place = np.int64(ranks[slots[slot]]) * RECORD
            low, high = low + load(pairs.sums, place), high + load(pairs.sums, place + 8)
            seen = base + l
        store(sums, _PILE * 8 + l * RECORD, low)
        store(sums, _PILE * 8 + l * RECORD + 8, high)
    for l in range(8):
        for k in range(NUM_SUMS):
            sums[k * 8 + l] = sums[_PILE * 8 + l * RECORD + k] if l < count else _ZERO
    return seen


@inlined
def _gather_block(splats, pairs, block, lanes, sums):
    """Transpose 8 Gaussians and what their records hold of the projection.

    A stand-in takes the lane of a Gaussian without tiles: its sums are 0 but its projection may
    be infinite, and 0 times infinity would be NaN.
    """
    base, count, stand_in = block
    starts, records = pairs.starts, pairs.records
    for l in range(8):
        has_tiles = l < count and starts[base + l + 1] > starts[base + l]
        i = base + l if has_tiles else stand_in
        gather_lane(splats, i, l, lanes)
        sums[_SUM_E1 * 8 + l] = records[i * RECORD + E1]
        sums[_SUM_SHEAR * 8 + l] = records[i * RECORD + SHEAR]
        sums[_SUM_E2 * 8 + l] = records[i * RECORD + E2]


@inlined
def _screen_gradients(sums):
    """Gradients at the screen mean and, doubled, at the covariance, from the whitened moments.

    With L the whitening (e = L d), d(exponent) = (L^T e) . d(mean) + (L^T e)(L^T e)^T : d(cov) / 2.
    """
    e1, e2 = load(sums, _SUM_E1 * 8), load(sums, _SUM_E2 * 8)
    slide = load(sums, _SUM_SHEAR * 8) * e2 * np.float32(-1.0)
    m1, m2 = load(sums, MOMENT_1 * 8), load(sums, MOMENT_2 * 8)
    m11, m12 = load(sums, MOMENT_11 * 8), load(sums, MOMENT_12 * 8)
    m22 = load(sums, MOMENT_22 * 8)
    x, y = (e1 * m1 + slide * m2) * _SIXTEEN, e2 * m2 * _SIXTEEN
    aa = e1 * (e1 * m11 + slide * m12 * _TWO) + slide * slide * m22
    ab = e2 * (e1 * m12 + slide * m22)
    return (x, y), (aa * _WHITENING, ab * _WHITENING, e2 * e2 * m22 * _WHITENING)


@inlined
def _block_gradients(lanes, camera, sums, out, pose):
    """Chain rule through the covariance and the mean of 8 Gaussians."""
    block = load_block(lanes)
    seen = project_block(block, camera)
    screen, (aa, ab, cc) = _screen_gradients(sums)
    spread_x, spread_y = seen.spread
    to_spread = combined(spread_x, aa, spread_y, ab), combined(spread_x, ab, spread_y, cc)
    scales = _sum(product(to_spread[0], seen.plain[0]), product(to_spread[1], seen.plain[1]))
    to_plain = product(to_spread[0], block.scale), product(to_spread[1], block.scale)
    to_rows = weighted(seen.axes, to_plain[0]), weighted(seen.axes, to_plain[1])
    point = _camera_point_gradient(seen, camera, sums, screen, to_rows)
    rows = rotation_rows(camera.pose)
    _store_three(out, _MEAN, weighted(rows, point))
    _store_three(out, _SCALE, scales)
    _store_quat(out, block, seen.rows, to_plain)
    store(out, _OPACITY * 8, load(sums, MOMENT * 8) / block.opacity)
    store(out, _SCREEN * 8, screen[0])
    store(out, (_SCREEN + 1) * 8, screen[1])
    _add_pose(pose, block.mean, seen.jacobian, to_rows, point)


@inlined
def _sum(u, v):
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@inlined
def _camera_point_gradient(seen, camera, sums, screen, to_rows):
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
    return x, y, load(sums, DEPTH_SUM * 8) - by_pixel - by_jacobian * seen.inverse_z


@inlined
def _store_three(out, row, vector):
    store(out, row * 8, vector[0])
    store(out, row * 8 + 8, vector[1])
    store(out, row * 8 + 16, vector[2])


@inlined
def _store_quat(out, block, rows, to_plain):
    """Through the rotation and the normalisation of the quaternion."""
    columns = (
        combined(rows[0], to_plain[0][0], rows[1], to_plain[1][0]),
        combined(rows[0], to_plain[0][1], rows[1], to_plain[1][1]),
        combined(rows[0], to_plain[0][2], rows[1], to_plain[1][2]),
    )
    q = block.quat
    w, x, y, z = quaternion_gradient(q, columns)
    along = w * q[0] + x * q[1] + y * q[2] + z * q[3]
    store(out, _QUAT * 8, (w - along * q[0]) * block.quat_scale)
    store(out, _QUAT * 8 + 8, (x - along * q[1]) * block.quat_scale)
    store(out, _QUAT * 8 + 16, (y - along * q[2]) * block.quat_scale)
    store(out, _QUAT * 8 + 24, (z - along * q[3]) * block.quat_scale)


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
    _add_to(pose, row * 8, rotation[0])
    _add_to(pose, row * 8 + 8, rotation[1])
    _add_to(pose, row * 8 + 16, rotation[2])
    _add_to(pose, row * 8 + 24, translation)


@inlined
def _add_to(pose, place, lanes):
    store(pose, place, load(pose, place) + lanes)


@inlined
def _write_block(gradients, camera, block, sums, out):
    base, count = block
    for l in range(count):
        i = base + l
        for k in range(3):
            gradients.means[i * 3 + k] = out[(_MEAN + k) * 8 + l]
            gradients.scales[i * 3 + k] = out[(_SCALE + k) * 8 + l]
            gradients.colours[i * 3 + k] = sums[k * 8 + l]
        for k in range(4):
            gradients.quats[i * 4 + k] = out[(_QUAT + k) * 8 + l]
        gradients.opacities[i] = out[_OPACITY * 8 + l]
        x = out[_SCREEN * 8 + l] * np.float32(camera.width) / _TWO
        y = out[(_SCREEN + 1) * 8 + l] * np.float32(camera.height) / _TWO
        gradients.screen[i] = math.sqrt(x * x + y * y)


@inlined
def _write_nothing(gradients, base, count):
    for i in range(base, base + count):
        for k in range(3):
            gradients.means[i * 3 + k] = _ZERO
            gradients.scales[i * 3 + k] = _ZERO
            gradients.colours[i * 3 + k] = _ZERO
        for k in range(4):
            gradients.quats[i * 4 + k] = _ZERO
        gradients.opacities[i] = _ZERO
        gradients.screen[i] = _ZERO
