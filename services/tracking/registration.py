"""Coarse pose: robust point-to-plane registration of a frame's surface to the local map.

Each source point looks for the nearest plane among the eight voxels around it that face its way
(Rusinkiewicz and Levoy, 3DIM 2001, for the variants; Segal et al., RSS 2009, for the metric: with
normals on both sides GICP weighs the distance along the normal, which is what is left of it
here). Increments are twists (rho, phi) in the camera frame: `T_world_camera @ exp(twist)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import RegistrationConfig
from services.tracking.normal_equations import NormalEquations, known_directions
from services.tracking.registration_kernels import (
    MIN_CORRESPONDENCES,
    accumulate,
    correspond,
    descend,
    residual_scale,
)
from services.tracking.twists import exp_twist, inverse_rigid, log_twist
from services.tracking.voxel_map import VoxelLevel, VoxelMap
from shared.se3 import orthonormalise
from shared.tracks import PointCloud


@dataclass(frozen=True)
class Registration:
    """A registered pose, and how the cost looks around it: `information` of a camera twist."""

    T_world_camera: NDArray[np.float64]  # [4, 4]
    information: NDArray[np.float64]  # [6, 6]
    gradient: NDArray[np.float64]  # [6], half that of the cost, at this pose
    overlap: float  # share of the source that has a plane in the map
    residual_scale: float  # in depth sigmas


def align(
    source: PointCloud,
    target: VoxelMap,
    T_world_camera: NDArray[np.float64],
    config: RegistrationConfig,
) -> Registration:
    """Register a cloud of the camera frame to the map, coarse to fine.

    Args:
        source: camera frame, normals towards the camera.
        target: levels of the config's voxel sizes.
        T_world_camera: where to start, [4, 4].
        config: levels, kernel, tolerances.
    """
    T = T_world_camera
    for index, level in enumerate(target.levels):
        T = _align_level(_every(source, config.sample_steps[index]), level, T, index, config)
    return _without_slide(source, target.levels[-1], orthonormalise(T), T_world_camera, config)


def _without_slide(
    source: PointCloud,
    level: VoxelLevel,
    T: NDArray[np.float64],
    T_start: NDArray[np.float64],
    config: RegistrationConfig,
) -> Registration:
    """At a registered pose, but back at the start along what the geometry leaves open.

    Only here: on the way the normals differ because the pose is off, not because of noise.
    """
    equations = _finest_equations(source, level, T, config)
    back = log_twist(inverse_rigid(T) @ T_start)
    slide = back - equations.projector(config.min_eigenvalue_share) @ back
    if np.linalg.norm(slide) < config.tolerances[-1]:
        return _registration(T, equations, config)
    return linearise(source, level, T @ exp_twist(slide), config)


def _every(cloud: PointCloud, step: int) -> PointCloud:
    points, normals = cloud.points[::step], cloud.normals[::step]
    return PointCloud(np.ascontiguousarray(points), np.ascontiguousarray(normals))


def _align_level(
    source: PointCloud,
    level: VoxelLevel,
    T: NDArray[np.float64],
    index: int,
    config: RegistrationConfig,
) -> NDArray[np.float64]:
    """Iterate on one level until it has no more to say than the next one will."""
    stop = (config.max_iterations[index], config.tolerances[index], config.min_eigenvalue_share)
    return descend(
        (source.points, source.normals),
        _arrays(level),
        T,
        _limits(config),
        np.array([config.kernel_width, config.min_kernel_width]),
        np.array(stop),
    )


def _arrays(level: VoxelLevel) -> tuple[float, NDArray, NDArray, NDArray]:
    """What the kernels take, in their order."""
    return level.voxel_size_m, level.keys, level.rows, level.planes


def _limits(config: RegistrationConfig) -> NDArray[np.float64]:
    limits = (config.min_normal_cos, config.depth_sigma_floor_m, config.depth_sigma_per_m2)
    return np.array(limits)


def linearise(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> Registration:
    """The registration's cost around a pose, without a step."""
    return _registration(T, _finest_equations(source, level, T, config), config)


def _finest_equations(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> NormalEquations:
    return _normal_equations(_every(source, config.sample_steps[-1]), level, T, config)


def _registration(
    T: NDArray[np.float64], equations: NormalEquations, config: RegistrationConfig
) -> Registration:
    """In units of what is independent, of the directions that the geometry holds."""
    known = equations.projector(config.min_eigenvalue_share)
    sigma = max(equations.residual_scale, config.model_sigma)
    factor = config.sample_steps[-1] * config.effective_share / sigma**2
    return Registration(
        T,
        factor * known.T @ equations.H @ known,
        factor * known.T @ equations.b,
        equations.overlap,
        equations.residual_scale,
    )


def overlap(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> float:
    """Share of the source that has a plane of the level within a voxel's side at a pose."""
    sample = _every(source, config.sample_steps[0])
    found, _, _ = correspond((sample.points, sample.normals), _arrays(level), T, _limits(config))
    return len(found) / max(1, len(sample.points))


def optimum(registration: Registration, config: RegistrationConfig) -> NDArray[np.float64]:
    """The pose where a linearised registration has its minimum, T_world_camera."""
    H, share = registration.information, config.min_eigenvalue_share
    basis = known_directions(H, H, share)
    return registration.T_world_camera @ exp_twist(-basis @ (basis.T @ registration.gradient))


def _normal_equations(
    source: PointCloud, level: VoxelLevel, T: NDArray[np.float64], config: RegistrationConfig
) -> NormalEquations:
    """The system of the robust cost at a pose; empty where hardly anything corresponds."""
    cloud, planes, limits = (source.points, source.normals), _arrays(level), _limits(config)
    found = correspond(cloud, planes, T, limits)
    residuals = found[2]
    if len(residuals) < MIN_CORRESPONDENCES:
        return NormalEquations(np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), 0.0, 1.0)
    scale = residual_scale(residuals)
    width = max(config.kernel_width * scale, config.min_kernel_width)
    H, signal, b = accumulate(cloud, planes, (T, limits, width), found, True)
    return NormalEquations(H, signal, b, len(residuals) / len(source.points), scale)
