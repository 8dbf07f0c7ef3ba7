"""Rigid transforms as 4x4 float64 matrices, named `T_target_source`, and poses as named fields.

`points_target = transform(T_target_source, points_source)`. Twists are (rho, phi): translation
first, rotation second, applied on the left: `exp(twist) @ T`. Formulas: Sola et al., "A micro Lie
theory for state estimation in robotics" (arXiv 1812.01537), appendix D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError

Matrix = NDArray[np.float64]

_SMALL_ANGLE = 1e-8


@dataclass(frozen=True)
class Vector3:
    """A point or direction with named components."""

    x: float
    y: float
    z: float


@dataclass(frozen=True)
class Quaternion:
    """A rotation as a Hamilton quaternion with named components; it need not be normalised."""

    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True)
class Pose:
    """A rigid transform as every outer interface spells it (metres, named quaternion fields)."""

    position: Vector3
    orientation: Quaternion

    @staticmethod
    def from_matrix(T: Matrix) -> Pose:
        """Name the components of a 4x4 transform."""
        x, y, z, w = quat_xyzw_from_rotation(T[:3, :3])
        return Pose(Vector3(*(float(c) for c in T[:3, 3])), Quaternion(x, y, z, w))

    def matrix(self) -> Matrix:
        """The transform as a 4x4 matrix.

        Raises:
            InputError: a component is not finite or the quaternion has no length.
        """
        p, q = self.position, self.orientation
        return from_quat_xyzw([q.x, q.y, q.z, q.w], [p.x, p.y, p.z])


def from_rotation(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Put a 3x3 rotation and a translation into a 4x4 transform."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T: Matrix) -> Matrix:
    """The inverse transform: `inverse(T_a_b)` is `T_b_a`. T: [..., 4, 4]."""
    rotation_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = rotation_inverse
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_inverse, T[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform(T_target_source: Matrix, points_source: NDArray) -> NDArray:
    """Points [N, 3] of the source frame in the target frame, in the points' own precision."""
    rotation = T_target_source[:3, :3].astype(points_source.dtype)
    return points_source @ rotation.T + T_target_source[:3, 3].astype(points_source.dtype)


def rotate(T_target_source: Matrix, directions_source: NDArray) -> NDArray:
    """Directions [N, 3] of the source frame in the target frame."""
    return directions_source @ T_target_source[:3, :3].astype(directions_source.dtype).T


def skew(v: NDArray) -> Matrix:
    """The matrix of the cross product: `skew(v) @ u == cross(v, u)`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp(twist: ArrayLike) -> Matrix:
    """Exponential of a twist (rho, phi), [6], as a 4x4 transform (Sola, Eq. 172-174)."""
    xi = np.asarray(twist, np.float64)
    phi = skew(xi[3:])
    angle = float(np.linalg.norm(xi[3:]))
    if angle < _SMALL_ANGLE:
        a, b, c = 1.0, 0.5, 1.0 / 6.0
    else:
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / angle**2
        c = (angle - math.sin(angle)) / angle**3
    squared = phi @ phi
    left_jacobian = np.eye(3) + b * phi + c * squared
    return from_rotation(np.eye(3) + a * phi + b * squared, left_jacobian @ xi[:3])


def log(T: Matrix) -> NDArray[np.float64]:
    """The twist (rho, phi), [6], with `exp(log(T)) == T` and an angle up to pi."""
    phi = _rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    cross = skew(phi)
    if angle < 1e-4:
        factor = 1.0 / 12.0
    else:
        factor = 1.0 / angle**2 - (1.0 + math.cos(angle)) / (2.0 * angle * math.sin(angle) + 1e-300)
        if abs(math.pi - angle) < 1e-6:
            factor = 1.0 / angle**2
    inverse_jacobian = np.eye(3) - 0.5 * cross + factor * (cross @ cross)
    return np.concatenate([inverse_jacobian @ T[:3, 3], phi])


def _rotation_log(rotation: Matrix) -> NDArray[np.float64]:
    """Rotation vector through the quaternion, which stays exact near pi."""
    q = np.array(quat_xyzw_from_rotation(rotation))
    length = float(np.linalg.norm(q[:3]))
    if length < 1e-12:
        return 2.0 * q[:3]
    return 2.0 * math.atan2(length, q[3]) / length * q[:3]


def angle_rad(T: Matrix) -> float:
    """Angle of the rotation, radians, 0 to pi."""
    return float(np.linalg.norm(_rotation_log(T[:3, :3])))


def quat_xyzw_from_rotation(rotation: Matrix) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) with w >= 0 (Bar-Itzhack's eigenvector form: no branches)."""
    m = np.asarray(rotation, np.float64)
    (a, b, c), (d, e, f), (g, h, i) = m
    symmetric = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(symmetric)[1][:, -1]
    sign = -1.0 if w < 0 else 1.0
    return float(sign * x), float(sign * y), float(sign * z), float(sign * w)


def from_quat_xyzw(quat_xyzw: ArrayLike, translation: ArrayLike) -> Matrix:
    """Transform from a quaternion (x, y, z, w), normalised here, and a translation in metres.

    Raises:
        InputError: a component is not finite or the quaternion has no length.
    """
    q = np.asarray(quat_xyzw, np.float64)
    t = np.asarray(translation, np.float64)
    if not np.isfinite(t).all():
        raise InputError("position", f"must be finite, got {t.tolist()}")
    length = float(np.linalg.norm(q))
    if not np.isfinite(length) or length < 1e-6:
        raise InputError("orientation", f"must be a finite quaternion, got {q.tolist()}")
    x, y, z, w = q / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return from_rotation(rotation, t)


def orthonormalise(T: Matrix) -> Matrix:
    """The nearest rigid transform, to stop rounding from growing over long products."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    return from_rotation(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, T[:3, 3])


def interpolate(T_a: Matrix, T_b: Matrix, fraction: float) -> Matrix:
    """The pose at `fraction` of the way from a to b (constant twist between them)."""
    return exp(fraction * log(T_b @ inverse(T_a))) @ T_a
