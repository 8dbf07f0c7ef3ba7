"""Compiled exponential and logarithm of SE(3), for the inner loops; twins of `shared.se3`."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def exp_twist(twist):  # pragma: no cover - compiled
    """Twist (rho, phi) [6] to a transform [4, 4]; see `shared.se3.exp`."""
    x, y, z = twist[3], twist[4], twist[5]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    if angle < 1e-6:
        a, b, c = 1.0 - squared / 6.0, 0.5 - squared / 24.0, 1.0 / 6.0 - squared / 120.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / squared
        c = (angle - np.sin(angle)) / (squared * angle)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    KK = K @ K
    T = np.eye(4)
    T[:3, :3] += a * K + b * KK
    V = np.eye(3) + b * K + c * KK
    for i in range(3):
        T[i, 3] = V[i, 0] * twist[0] + V[i, 1] * twist[1] + V[i, 2] * twist[2]
    return T


@numba.njit(cache=True, nogil=True)
def log_twist(T):  # pragma: no cover - compiled
    """Transform to twist, for rotations below 150 degrees; see `shared.se3.log`."""
    axis = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    sine = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    angle = np.arctan2(sine, 0.5 * (T[0, 0] + T[1, 1] + T[2, 2] - 1.0))
    squared = angle * angle
    if angle < 1e-4:
        scale, factor = 1.0 + squared / 6.0, 1.0 / 12.0 + squared / 720.0
    else:
        scale = angle / sine
        factor = 1.0 / squared - (1.0 + np.cos(angle)) / (2.0 * angle * sine)
    phi = scale * axis
    K = np.array([[0.0, -phi[2], phi[1]], [phi[2], 0.0, -phi[0]], [-phi[1], phi[0], 0.0]])
    V = np.eye(3) - 0.5 * K + factor * (K @ K)
    twist = np.zeros(6)
    for i in range(3):
        twist[i] = V[i, 0] * T[0, 3] + V[i, 1] * T[1, 3] + V[i, 2] * T[2, 3]
        twist[3 + i] = phi[i]
    return twist


@numba.njit(cache=True, nogil=True)
def inverse_rigid(T):  # pragma: no cover - compiled
    """Inverse of a transform [4, 4]."""
    out = np.eye(4)
    for i in range(3):
        for j in range(3):
            out[i, j] = T[j, i]
            out[i, 3] -= T[j, i] * T[j, 3]
    return out
