"""Pose graph: the poses of all keyframes that agree best with what was measured between them.

Levenberg-Marquardt on SE(3) over sparse normal equations, with Huber's kernel on the edges that
may be wrong. Residual of an edge: log(T_first_second^-1 T_first^-1 T_second); poses move by twists
on their right (Grisetti et al., "A tutorial on graph-based SLAM", 2010).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from shared.errors import ConfigError
from shared.se3 import inverse

Array = NDArray[np.float64]
_MAX_DAMPING = 1e8


@dataclass(frozen=True)
class PoseGraphConfig:
    """How a pose graph is solved."""

    iterations: int = 20
    huber_sigma: float = 3.0
    relative_tolerance: float = 1e-6  # of the cost: a smaller gain ends the search

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.huber_sigma <= 0:
            raise ConfigError("pose_graph: iterations and huber_sigma must be positive")


@dataclass(frozen=True)
class PoseGraph:
    """Poses and the edges between them; the first pose holds the world in place."""

    T_world_poses: Array  # [K, 4, 4]
    first: NDArray[np.int64]  # [E], row of a pose
    second: NDArray[np.int64]  # [E]
    T_first_second: Array  # [E, 4, 4]
    information: Array  # [E, 6, 6], of a twist on the right
    is_robust: NDArray[np.bool_]  # [E], edges that may be wrong


def residuals(graph: PoseGraph) -> Array:
    """What separates the poses from each edge's measurement, a twist, [E, 6]."""
    return _residuals(graph, graph.T_world_poses)


def solve_pose_graph(graph: PoseGraph, config: PoseGraphConfig) -> Array:
    """Poses of least cost, [K, 4, 4]; never worse than the start."""
    poses, damping = graph.T_world_poses, 1e-6
    cost = _cost(graph, poses, config)
    for _ in range(config.iterations):
        H, b = _normal_equations(graph, poses, config)
        before = cost
        while damping <= _MAX_DAMPING:
            candidate = _moved(poses, _solve(H, b, damping))
            candidate_cost = _cost(graph, candidate, config)
            if candidate_cost < cost:
                poses, cost, damping = candidate, candidate_cost, max(0.1 * damping, 1e-9)
                break
            damping *= 10.0
        if before - cost <= config.relative_tolerance * before:
            break
    return poses


def _residuals(graph: PoseGraph, poses: Array) -> Array:
    steps = inverse(poses[graph.first]) @ poses[graph.second]
    return log_twists(inverse(graph.T_first_second) @ steps)


def _chi(graph: PoseGraph, r: Array) -> Array:
    """Length of each residual in sigmas, [E]."""
    return np.sqrt(np.einsum("ei,eij,ej->e", r, graph.information, r))


def _cost(graph: PoseGraph, poses: Array, config: PoseGraphConfig) -> float:
    chi, width = _chi(graph, _residuals(graph, poses)), config.huber_sigma
    is_far = graph.is_robust & (chi > width)
    return float(np.where(is_far, width * (2.0 * chi - width), chi**2).sum())


def _normal_equations(
    graph: PoseGraph, poses: Array, config: PoseGraphConfig
) -> tuple[sparse.csc_array, Array]:
    """H and b of the twists of all poses but the first."""
    steps = inverse(poses[graph.first]) @ poses[graph.second]
    r = log_twists(inverse(graph.T_first_second) @ steps)
    chi, width = _chi(graph, r), config.huber_sigma
    weights = np.where(graph.is_robust, width / np.maximum(chi, width), 1.0)
    second = _inverse_right_jacobians(r)
    first = -second @ _adjoints(inverse(steps))
    information = weights[:, None, None] * graph.information
    rows = (graph.first, graph.second)
    b = np.zeros((len(poses), 6))
    blocks, at = [], []
    for row, J in zip(rows, (first, second), strict=True):
        weighted = np.swapaxes(J, 1, 2) @ information
        np.add.at(b, row, np.einsum("eij,ej->ei", weighted, r))
        blocks += [weighted @ first, weighted @ second]
        at += [np.stack([row, rows[0]]), np.stack([row, rows[1]])]
    H = _assemble(np.concatenate(blocks), np.concatenate(at, axis=1), len(poses))
    return H[6:, 6:], b[1:].ravel()


def _assemble(blocks: Array, at: NDArray[np.int64], count: int) -> sparse.csc_array:
    """A matrix of 6x6 blocks from blocks that add up, at (row, column), [2, N]."""
    keys, places = np.unique(at[0] * count + at[1], return_inverse=True)
    summed = np.zeros((len(keys), 6, 6))
    np.add.at(summed, places, blocks)
    starts = np.searchsorted(keys // count, np.arange(count + 1))
    return sparse.bsr_array((summed, keys % count, starts)).tocsc()


def _solve(H: sparse.csc_array, b: Array, damping: float) -> Array:
    damped = H + sparse.diags_array(damping * H.diagonal() + 1e-12, format="csc")
    options = {"SymmetricMode": True}
    factors = splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return -factors.solve(b).reshape(-1, 6)


def _moved(poses: Array, twists: Array) -> Array:
    return np.concatenate([poses[:1], poses[1:] @ exp_twists(twists)])


def _skews(v: Array) -> Array:
    """Cross product matrices of [N, 3]."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v[:, 0], v[:, 1], v[:, 2]
    return out - np.swapaxes(out, 1, 2)


def exp_twists(twists: Array) -> Array:
    """`shared.se3.exp` of many twists, [N, 6] to [N, 4, 4]."""
    phi = _skews(twists[:, 3:])
    squared = phi @ phi
    angle = np.maximum(np.linalg.norm(twists[:, 3:], axis=1), 1e-6)[:, None, None]
    sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    left = np.eye(3) + cosine * phi + (1.0 - sine) / angle**2 * squared
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] += sine * phi + cosine * squared
    T[:, :3, 3] = np.einsum("nij,nj->ni", left, twists[:, :3])
    return T


def log_twists(T: Array) -> Array:
    """`shared.se3.log` of many transforms that turn by less than pi, [N, 4, 4] to [N, 6]."""
    R = T[:, :3, :3]
    sine = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    length = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(length, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    is_small = length < 1e-7
    phi = np.where(is_small, 1.0, angle / np.where(is_small, 1.0, length))[:, None] * sine
    half = np.where(is_small, 1e-4, 0.5 * angle)
    factor = (1.0 - half / np.tan(half)) / (4.0 * half**2)
    cross = _skews(phi)
    inverse_left = np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross)
    return np.concatenate([np.einsum("nij,nj->ni", inverse_left, T[:, :3, 3]), phi], axis=1)


def _adjoints(T: Array) -> Array:
    """Ad(T) for twists (rho, phi), [N, 6, 6]."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, :3, 3:] = _skews(T[:, :3, 3]) @ R
    return out


def _inverse_right_jacobians(twists: Array) -> Array:
    """Of the exponential, [N, 6, 6]; the series leaves 1e-5 at half a radian."""
    ad = np.zeros((len(twists), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = _skews(twists[:, 3:])
    ad[:, :3, 3:] = _skews(twists[:, :3])
    squared = ad @ ad
    return np.eye(6) + 0.5 * ad + squared / 12.0 - squared @ squared / 720.0
