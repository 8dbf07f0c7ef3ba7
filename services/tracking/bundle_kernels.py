"""Compiled loops of the bundle adjustment; `bundle_adjustment.py` says what they are for.

K cameras, L landmarks, O observations in ascending order of the landmark. Views are
T_camera_world [K, 4, 4]; camera is (fx, fy, cx, cy); increments are twists in the camera frame,
T_world_camera @ exp(twist), so that a point of the camera frame moves by -(rho + phi x y).

A state is (views, points [L, 3]); what was seen is (camera_index [O], point_index [O], measured
[O, 3], sigmas [O, 2]), as in `BundleProblem`; a system is (Hcc, Hpp, Hcp, bc, bp).
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _residuals(view, X, observation, camera, out):  # pragma: no cover - compiled
    """Fill the camera point y [3] and the normalised residuals r [3]."""
    measured, sigmas = observation
    y, r = out
    for i in range(3):
        y[i] = view[i, 0] * X[0] + view[i, 1] * X[1] + view[i, 2] * X[2] + view[i, 3]
    z = max(y[2], 0.05)
    r[0] = (camera[0] * y[0] / z + camera[2] - measured[0]) / sigmas[0]
    r[1] = (camera[1] * y[1] / z + camera[3] - measured[1]) / sigmas[0]
    r[2] = (y[2] - measured[2]) / sigmas[1] if measured[2] > 0.0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def huber_cost(state, seen, camera, huber):  # pragma: no cover - compiled
    """Sum of the Huber kernel over pixels and depths."""
    views, points = state
    camera_index, point_index, measured, sigmas = seen
    y = np.zeros(3)
    r = np.zeros(3)
    cost = 0.0
    for o in range(len(camera_index)):
        view, X = views[camera_index[o]], points[point_index[o]]
        _residuals(view, X, (measured[o], sigmas[o]), camera, (y, r))
        for error in (np.sqrt(r[0] * r[0] + r[1] * r[1]), abs(r[2])):
            cost += error * error if error < huber else huber * (2.0 * error - huber)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linearise(state, seen, camera, huber):  # noqa: C901  # pragma: no cover - compiled
    """Blocks of the normal equations: Hcc, Hpp, Hcp (one an observation), bc, bp."""
    views, points = state
    camera_index, point_index, measured, sigmas = seen
    Hcc = np.zeros((len(views), 6, 6))
    Hpp = np.zeros((len(points), 3, 3))
    Hcp = np.zeros((len(camera_index), 6, 3))
    bc = np.zeros((len(views), 6))
    bp = np.zeros((len(points), 3))
    y = np.zeros(3)
    r = np.zeros(3)
    weights = np.zeros(3)
    g = np.zeros((3, 3))
    Jc = np.zeros((3, 6))
    Jp = np.zeros((3, 3))
    for o in range(len(camera_index)):
        k, l = camera_index[o], point_index[o]
        view = views[k]
        _residuals(view, points[l], (measured[o], sigmas[o]), camera, (y, r))
        error, depth_error = np.sqrt(r[0] * r[0] + r[1] * r[1]), abs(r[2])
        weights[0] = weights[1] = 1.0 if error < huber else huber / error
        weights[2] = 1.0 if depth_error < huber else huber / depth_error
        z = max(y[2], 0.05)
        g[0, 0] = camera[0] / z / sigmas[o, 0]
        g[0, 2] = -camera[0] * y[0] / (z * z) / sigmas[o, 0]
        g[1, 1] = camera[1] / z / sigmas[o, 0]
        g[1, 2] = -camera[1] * y[1] / (z * z) / sigmas[o, 0]
        g[2, 2] = 1.0 / sigmas[o, 1] if measured[o, 2] > 0.0 else 0.0
        for e in range(3):
            for i in range(3):
                Jc[e, i] = -g[e, i]
                Jp[e, i] = g[e, 0] * view[0, i] + g[e, 1] * view[1, i] + g[e, 2] * view[2, i]
            Jc[e, 3] = g[e, 1] * y[2] - g[e, 2] * y[1]
            Jc[e, 4] = g[e, 2] * y[0] - g[e, 0] * y[2]
            Jc[e, 5] = g[e, 0] * y[1] - g[e, 1] * y[0]
        for e in range(3 if measured[o, 2] > 0.0 else 2):
            for i in range(6):
                scaled = weights[e] * Jc[e, i]
                bc[k, i] += scaled * r[e]
                for j in range(i, 6):
                    Hcc[k, i, j] += scaled * Jc[e, j]
                for j in range(3):
                    Hcp[o, i, j] += scaled * Jp[e, j]
            for i in range(3):
                scaled = weights[e] * Jp[e, i]
                bp[l, i] += scaled * r[e]
                for j in range(3):
                    Hpp[l, i, j] += scaled * Jp[e, j]
    for k in range(len(views)):
        for i in range(6):
            for j in range(i):
                Hcc[k, i, j] = Hcc[k, j, i]
    return Hcc, Hpp, Hcp, bc, bp


@numba.njit(cache=True, nogil=True, error_model="numpy")
def eliminate_landmarks(  # noqa: C901 - compiled
    system, camera_index, starts, damping
):  # pragma: no cover - compiled
    """Schur complement of the landmarks: the reduced system S, b and the inverses of Hpp."""
    Hcc, Hpp, Hcp, bc, bp = system
    count = len(Hcc)
    S = np.zeros((6 * count, 6 * count))
    b = bc.copy().reshape(6 * count)
    inverses = np.zeros_like(Hpp)
    T = np.zeros((6, 3))
    for k in range(count):
        for i in range(6):
            for j in range(6):
                S[6 * k + i, 6 * k + j] = Hcc[k, i, j] * (1.0 + damping if i == j else 1.0)
            S[6 * k + i, 6 * k + i] += 1e-9
    for l in range(len(Hpp)):
        _invert(Hpp[l], damping, inverses[l])
        for o in range(starts[l], starts[l + 1]):
            row = 6 * camera_index[o]
            for i in range(6):
                for j in range(3):
                    T[i, j] = 0.0
                    for e in range(3):
                        T[i, j] += Hcp[o, i, e] * inverses[l, e, j]
                b[row + i] -= T[i, 0] * bp[l, 0] + T[i, 1] * bp[l, 1] + T[i, 2] * bp[l, 2]
            for other in range(o, starts[l + 1]):  # cameras ascend: the upper blocks
                column = 6 * camera_index[other]
                W = Hcp[other]
                for i in range(6):
                    for j in range(6):
                        S[row + i, column + j] -= (
                            T[i, 0] * W[j, 0] + T[i, 1] * W[j, 1] + T[i, 2] * W[j, 2]
                        )
    for row in range(6, 6 * count):
        for column in range(row - row % 6):
            S[row, column] = S[column, row]
    return S, b, inverses


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _invert(H, damping, out):  # pragma: no cover - compiled
    """Inverse of a damped symmetric 3x3 matrix."""
    a = H[0, 0] * (1.0 + damping) + 1e-9
    d = H[1, 1] * (1.0 + damping) + 1e-9
    f = H[2, 2] * (1.0 + damping) + 1e-9
    b, c, e = H[0, 1], H[0, 2], H[1, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    inverse_det = 1.0 / (a * A + b * B + c * C)
    out[0, 0] = A * inverse_det
    out[0, 1] = out[1, 0] = B * inverse_det
    out[0, 2] = out[2, 0] = C * inverse_det
    out[1, 1] = (a * f - c * c) * inverse_det
    out[1, 2] = out[2, 1] = (b * c - a * e) * inverse_det
    out[2, 2] = (a * d - b * b) * inverse_det


@numba.njit(cache=True, nogil=True, error_model="numpy")
def back_substitute(inverses, Hcp, bp, camera_index, starts, twists):  # noqa: PLR0913 - compiled
    """Moves of the landmarks that belong to the cameras' twists."""
    moves = np.zeros((len(inverses), 3))
    g = np.zeros(3)
    for l in range(len(inverses)):
        for i in range(3):
            g[i] = bp[l, i]
        for o in range(starts[l], starts[l + 1]):
            row = 6 * camera_index[o]
            for i in range(3):
                for j in range(6):
                    g[i] += Hcp[o, j, i] * twists[row + j]
        for i in range(3):
            moves[l, i] = -(
                inverses[l, i, 0] * g[0] + inverses[l, i, 1] * g[1] + inverses[l, i, 2] * g[2]
            )
    return moves
