"""Local bundle adjustment: poses and landmarks of a window, by Levenberg-Marquardt.

Paper Eq. 2 over the window, with depth as a third residual (the depth prior) and a Huber kernel.
Landmarks are eliminated by the Schur complement. Each free pose has a prior whose information is
what the geometry knows of it: exact depth must not be spoilt by features good to a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.tracking.bundle_kernels import (
    back_substitute,
    eliminate_landmarks,
    huber_cost,
    linearise,
)
from services.tracking.config import BundleAdjustmentConfig
from services.tracking.twists import exp_twist, log_twist
from shared.camera import Intrinsics
from shared.se3 import inverse

_MAX_DAMPING = 1e6
_CONVERGED = 1e-4  # of the cost: later steps were measured to move cameras by 0.01 mm


@dataclass(frozen=True)
class BundleProblem:
    """Poses, landmarks and what was seen; observations ascend by landmark, then camera."""

    T_world_cameras: NDArray[np.float64]  # [K, 4, 4]
    is_fixed: NDArray[np.bool_]  # [K]
    T_world_priors: NDArray[np.float64]  # [K, 4, 4], where geometry holds the cameras
    pose_information: NDArray[np.float64]  # [K, 6, 6], how firmly, of a camera twist from there
    points_world: NDArray[np.float64]  # [L, 3]
    camera_index: NDArray[np.int64]  # [O]
    point_index: NDArray[np.int64]  # [O], ascending
    measured: NDArray[np.float64]  # [O, 3], u and v in pixels, depth in metres (0: none)
    sigmas: NDArray[np.float64]  # [O, 2], of the pixels and of the depth


@dataclass(frozen=True)
class BundleSolution:
    """Poses and landmarks at the minimum."""

    T_world_cameras: NDArray[np.float64]  # [K, 4, 4]
    points_world: NDArray[np.float64]  # [L, 3]
    cost_before: float
    cost_after: float


def solve_bundle(
    problem: BundleProblem, intrinsics: Intrinsics, config: BundleAdjustmentConfig
) -> BundleSolution:
    """Minimise; a solution is never worse than the start."""
    solver = _Solver(problem, intrinsics, config)
    state = _State(problem.T_world_cameras, problem.points_world)
    start = cost = solver.cost(state)
    damping = 1e-4
    for _ in range(config.iterations):
        before = cost
        state, damping, cost = solver.descend(solver.linearise(state), state, cost, damping)
        if cost >= before * (1.0 - _CONVERGED):
            break
    return BundleSolution(state.T_world_cameras, state.points_world, start, cost)


def pixel_chi2(
    problem: BundleProblem, solution: BundleSolution, intrinsics: Intrinsics
) -> NDArray[np.float64]:
    """Squared reprojection errors at a solution, in variances of their pixels, [O]."""
    views = inverse(solution.T_world_cameras)[problem.camera_index]
    points = solution.points_world[problem.point_index]
    seen = np.einsum("oij,oj->oi", views[:, :3, :3], points) + views[:, :3, 3]
    i, z = intrinsics, np.maximum(seen[:, 2:], 0.05)
    pixels = seen[:, :2] / z * [i.fx, i.fy] + [i.cx, i.cy]
    errors = (pixels - problem.measured[:, :2]) / problem.sigmas[:, :1]
    return np.asarray(np.square(errors).sum(axis=1), np.float64)


@dataclass(frozen=True)
class _State:
    T_world_cameras: NDArray[np.float64]
    points_world: NDArray[np.float64]


@dataclass(frozen=True)
class _System:
    Hcc: NDArray[np.float64]  # [K, 6, 6]
    Hpp: NDArray[np.float64]  # [L, 3, 3]
    Hcp: NDArray[np.float64]  # [O, 6, 3]
    bc: NDArray[np.float64]  # [K, 6]
    bp: NDArray[np.float64]  # [L, 3]


class _Solver:
    """The parts of the problem that do not change from step to step."""

    def __init__(
        self, problem: BundleProblem, intrinsics: Intrinsics, config: BundleAdjustmentConfig
    ) -> None:
        assert (np.diff(problem.point_index) >= 0).all()
        p = self._problem = problem
        self._seen = (p.camera_index, p.point_index, p.measured, p.sigmas)
        self._huber = config.huber_sigma
        self._camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        landmarks = np.arange(len(problem.points_world) + 1)
        self._starts = np.searchsorted(problem.point_index, landmarks).astype(np.int64)
        self._free = np.flatnonzero(np.repeat(~problem.is_fixed, 6))

    def cost(self, state: _State) -> float:
        seen_from = (inverse(state.T_world_cameras), state.points_world)
        features = huber_cost(seen_from, self._seen, self._camera, self._huber)
        steps, information = self._steps(state), self._problem.pose_information
        return features + float(np.einsum("ki,kij,kj->", steps, information, steps))

    def _steps(self, state: _State) -> NDArray[np.float64]:
        start = inverse(self._problem.T_world_priors)
        return np.array(
            [log_twist(a @ b) for a, b in zip(start, state.T_world_cameras, strict=True)]
        )

    def linearise(self, state: _State) -> _System:
        p = self._problem
        seen_from = (inverse(state.T_world_cameras), state.points_world)
        Hcc, Hpp, Hcp, bc, bp = linearise(seen_from, self._seen, self._camera, self._huber)
        pull = np.einsum("kij,kj->ki", p.pose_information, self._steps(state))
        return _System(Hcc + p.pose_information, Hpp, Hcp, bc + pull, bp)

    def descend(
        self, system: _System, state: _State, cost: float, damping: float
    ) -> tuple[_State, float, float]:
        """The first step that lowers the cost, with the damping for the next one."""
        while damping <= _MAX_DAMPING:
            candidate = self._step(system, state, damping)
            candidate_cost = self.cost(candidate)
            if candidate_cost < cost:
                return candidate, max(0.2 * damping, 1e-9), candidate_cost
            damping *= 8.0
        return state, damping, cost

    def _step(self, system: _System, state: _State, damping: float) -> _State:
        p = self._problem
        S, b, Hpp_inverse = eliminate_landmarks(
            (system.Hcc, system.Hpp, system.Hcp, system.bc, system.bp),
            p.camera_index,
            self._starts,
            damping,
        )
        twists = np.zeros(6 * len(p.is_fixed))
        if len(self._free):
            reduced = S[np.ix_(self._free, self._free)]
            twists[self._free] = -np.linalg.solve(reduced, b[self._free])
        moves = back_substitute(
            Hpp_inverse, system.Hcp, system.bp, p.camera_index, self._starts, twists
        )
        poses = [
            T @ exp_twist(t)
            for T, t in zip(state.T_world_cameras, twists.reshape(-1, 6), strict=True)
        ]
        return _State(np.array(poses), state.points_world + moves)
