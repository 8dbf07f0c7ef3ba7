"""Paths of cameras, T_map_camera: smooth curves through poses, and circles around a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared import se3

_STEPS = 16  # looks at the speed between two poses
_SMALL_ANGLE = 1e-6
_RADIAN_M = 0.5  # a turn by a radian takes as long as half a metre


def smooth_path(T_keys: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Poses at an even speed on a smooth curve through key poses, [frames, 4, 4].

    Positions are a Catmull-Rom spline, orientations the quaternion curve of Shoemake ("Animating
    rotation with quaternion curves", 1985). As many frames as keys are the keys themselves.

    Args:
        T_keys: [K, 4, 4], at least one.
    """
    if frames == len(T_keys):
        return T_keys.copy()
    if len(T_keys) == 1:
        return np.repeat(T_keys, frames, axis=0)
    keys = T_keys[:, :3, 3], _quaternions(T_keys)
    at = np.linspace(0.0, len(T_keys) - 1.0, _STEPS * (len(T_keys) - 1) + 1)
    travelled = _travelled(*_curve(*keys, at))
    if travelled[-1] > 0.0:
        at = np.interp(np.linspace(0.0, travelled[-1], frames), travelled, at)
    positions, quats_xyzw = _curve(*keys, at)
    return np.stack([se3.from_quat_xyzw(*pose) for pose in zip(quats_xyzw, positions, strict=True)])


def timed_path(
    t_ns: NDArray[np.int64], T_map_cameras: NDArray[np.float64], frames: int
) -> NDArray[np.float64]:
    """Poses evenly in time along a recorded path, [frames, 4, 4]."""
    wanted = np.linspace(float(t_ns[0]), float(t_ns[-1]), frames)
    at = np.interp(wanted, t_ns.astype(np.float64), np.arange(len(t_ns)))
    before = np.minimum(at.astype(int), max(len(t_ns) - 2, 0))
    after = np.minimum(before + 1, len(t_ns) - 1)
    return np.stack(
        [
            se3.interpolate(T_map_cameras[a], T_map_cameras[b], u - a)
            for a, b, u in zip(before, after, at, strict=True)
        ]
    )


def orbit(
    T_first: NDArray[np.float64],
    centre: NDArray[np.float64],
    axis: NDArray[np.float64],
    turn: float,
) -> NDArray[np.float64]:
    """The pose that has turned by `turn` radians about an axis through a point, [4, 4]."""
    T_turn = se3.exp([0.0, 0.0, 0.0, *(turn * axis)])
    T_turn[:3, 3] = centre - T_turn[:3, :3] @ centre
    return T_turn @ T_first


def upward(T_map_cameras: NDArray[np.float64]) -> NDArray[np.float64]:
    """Which way is up in the map, [3], unit: people hold cameras upright on the mean."""
    up = -T_map_cameras[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])


def _travelled(positions: NDArray, quats: NDArray) -> NDArray[np.float64]:
    """How far it is to each pose, metres; turning counts too."""
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    cosines = np.abs((quats[1:] * quats[:-1]).sum(axis=1)).clip(max=1.0)
    return np.concatenate([[0.0], np.cumsum(steps_m + _RADIAN_M * 2.0 * np.arccos(cosines))])


def _quaternions(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orientations as unit quaternions xyzw, [K, 4], each on the side of the one before."""
    quats = np.array([se3.quat_xyzw_from_rotation(rotation) for rotation in T[:, :3, :3]])
    turns_over = (quats[1:] * quats[:-1]).sum(axis=1) < 0
    quats[1:] *= np.where(np.cumsum(turns_over) % 2 == 1, -1.0, 1.0)[:, None]
    return quats


def _curve(
    positions: NDArray, quats: NDArray, at: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [N, 3] and quaternions [N, 4] at parameters, of which the k-th key is at k."""
    last = len(positions) - 1
    i = np.minimum(at.astype(int), last - 1)
    t = (at - i)[:, None]
    around = np.stack([np.maximum(i - 1, 0), i, i + 1, np.minimum(i + 2, last)])
    return _catmull_rom(positions[around], t), _quaternion_curve(quats[around], t)


def _catmull_rom(points: NDArray, t: NDArray) -> NDArray[np.float64]:
    """Between the second and the third of four points, [4, N, 3]; t is [N, 1]."""
    p0, p1, p2, p3 = points
    cubic = 3 * (p1 - p2) + p3 - p0
    return p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * cubic))


def _quaternion_curve(quats: NDArray, t: NDArray) -> NDArray[np.float64]:
    """Between the second and the third of four, [4, N, 4]: de Casteljau on the sphere."""
    q0, q1, q2, q3 = quats
    after_q1 = _slerp(q1, _bisector(_double(q0, q1), q2), 1 / 3)
    before_q2 = _slerp(q2, _bisector(_double(q3, q2), q1), 1 / 3)
    points = [q1, after_q1, before_q2, q2]
    while len(points) > 1:
        points = [_slerp(a, b, t) for a, b in zip(points, points[1:], strict=False)]
    return points[0]


def _double(p: NDArray, q: NDArray) -> NDArray[np.float64]:
    """As far beyond q as p is before it."""
    return 2.0 * (p * q).sum(axis=1, keepdims=True) * q - p


def _bisector(p: NDArray, q: NDArray) -> NDArray[np.float64]:
    return (p + q) / np.linalg.norm(p + q, axis=1, keepdims=True).clip(min=1e-12)


def _slerp(p: NDArray, q: NDArray, t: NDArray | float) -> NDArray[np.float64]:
    cosine = (p * q).sum(axis=1, keepdims=True).clip(-1.0, 1.0)
    angle = np.arccos(cosine)
    sine = np.sin(angle).clip(min=1e-9)
    near = angle < _SMALL_ANGLE
    share_p = np.where(near, 1.0 - t, np.sin((1.0 - t) * angle) / sine)
    share_q = np.where(near, t, np.sin(t * angle) / sine)
    mixed = share_p * p + share_q * q
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
