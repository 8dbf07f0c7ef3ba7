"""One attempt at a frame's pose: registration, features, refinement, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TrackingConfig
from services.tracking.least_squares import Refinement, pose_observations, refine_pose
from services.tracking.local_map import LocalMap
from services.tracking.matching import Matches, match_by_projection
from services.tracking.observed import Observed
from services.tracking.registration import Registration, align, linearise
from services.tracking.stopwatch import Stopwatch
from services.tracking.verification import Agreement, depth_agreement
from shared.se3 import angle_rad, inverse
from shared.tracks import NO_LANDMARK

_SAME_M = 5e-4  # planes of the map
_SAME_RAD = 5e-4
_MATCHES_SAME_M = 5e-3  # features: some pixels, of the ten that they are looked for in
_MATCHES_SAME_RAD = 5e-3


@dataclass(frozen=True)
class Estimate:
    """A pose and the evidence for it."""

    T_world_camera: NDArray[np.float64]  # [4, 4]
    information: NDArray[np.float64]  # [6, 6], of a camera twist
    registration: Registration
    agreement: Agreement
    matches: Matches  # inliers only
    num_matches: int  # before the outliers left
    local: LocalMap

    @property
    def inliers(self) -> int:
        """Features that agree with the pose."""
        return len(self.matches)

    @property
    def inlier_share(self) -> float:
        """Of the matched features."""
        return self.inliers / max(1, self.num_matches)

    @property
    def score(self) -> float:
        """To choose between attempts at the same frame."""
        evidence = (10.0 + self.inliers) * (0.05 + self.registration.overlap)
        return evidence * self.agreement.belief**2

    def landmark_ids(self, num_features: int) -> NDArray[np.int64]:
        """Landmark of each feature of the frame, NO_LANDMARK where none, [M]."""
        ids = np.full(num_features, NO_LANDMARK, np.int64)
        ids[self.matches.features] = self.local.context.landmarks.ids[self.matches.landmarks]
        return ids


def pose_covariance(
    information: NDArray[np.float64], config: TrackingConfig
) -> NDArray[np.float64]:
    """Inverse of the information; what nothing is known of gets a metre or a radian, [6, 6]."""
    weakened = information / config.verification.covariance_scale
    return np.asarray(np.linalg.inv(weakened + np.eye(6)), np.float64)


def is_well_known(estimate: Estimate, config: TrackingConfig) -> bool:
    """Whether a pose is certain enough in every direction to hold a part of the map."""
    covariance, limits = pose_covariance(estimate.information, config), config.keyframe
    metres = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    degrees = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
    # Farther away the same error is fewer pixels, and less than what is seen there is known to.
    scale = max(1.0, _distance_m(estimate) / limits.std_distance_m)
    return metres <= limits.max_std_m * scale and degrees <= limits.max_std_deg


def _distance_m(estimate: Estimate) -> float:
    """Median distance of the landmarks that agree; zero without any."""
    points = estimate.local.context.landmarks.positions_world[estimate.matches.landmarks]
    if len(points) == 0:
        return 0.0
    return float(np.median(np.linalg.norm(points - estimate.T_world_camera[:3, 3], axis=1)))


def attempt(
    observed: Observed,
    local: LocalMap,
    T_start: NDArray[np.float64],
    config: TrackingConfig,
    clock: Stopwatch,
) -> Estimate:
    """Register from a starting pose, match features there, refine on both."""
    with clock.stage("coarse"):
        registration = align(observed.cloud, local.voxels, T_start, config.registration)
    with clock.stage("wait"):
        observed.wait()
    with clock.stage("refine"):
        still = _refine_until_still(observed, local, registration, config)
        agreement = depth_agreement(
            observed.image,
            local.context.cloud_world,
            still.refinement.T_world_camera,
            config.verification,
        )
    return Estimate(
        T_world_camera=still.refinement.T_world_camera,
        information=still.refinement.information,
        registration=still.registration,
        agreement=agreement,
        matches=still.matches.where(still.refinement.is_inlier),
        num_matches=len(still.matches),
        local=local,
    )


@dataclass(frozen=True)
class _Refined:
    refinement: Refinement
    matches: Matches
    registration: Registration  # linearised where the refinement began, at most a small step away


def _refine_until_still(
    observed: Observed, local: LocalMap, registration: Registration, config: TrackingConfig
) -> _Refined:
    """Refine; where that moved the pose, find correspondences anew and repeat."""
    matches = _matches(observed, local, registration.T_world_camera, config)
    if len(matches) < config.orb.few_matches:
        registration, matches = _drawn_by_features(observed, local, registration, matches, config)
    refinement = _refine(observed, local, registration, matches, config)
    for _ in range(config.refinement.max_relinearisations - 1):
        T = refinement.T_world_camera
        step = inverse(registration.T_world_camera) @ T
        if _is_within(step, _SAME_M, _SAME_RAD):
            break
        if not _is_within(step, _MATCHES_SAME_M, _MATCHES_SAME_RAD):
            matches = _matches(observed, local, T, config)
        registration = linearise(observed.cloud, local.voxels.levels[-1], T, config.registration)
        refinement = _refine(observed, local, registration, matches, config)
    return _Refined(refinement, matches, registration)


def _is_within(step: NDArray[np.float64], metres: float, radians: float) -> bool:
    """Whether what corresponds would stay the same after this step."""
    return float(np.linalg.norm(step[:3, 3])) < metres and angle_rad(step) < radians


def _drawn_by_features(
    observed: Observed,
    local: LocalMap,
    registration: Registration,
    matches: Matches,
    config: TrackingConfig,
) -> tuple[Registration, Matches]:
    """Where matches of a wider search draw the pose, if more features match there than did here.

    ORB-SLAM widens its search likewise: what geometry leaves open may be off by many pixels.
    """
    orb = replace(config.orb, search_radius_px=config.orb.wide_radius_px)
    T = registration.T_world_camera
    wide = _matches(observed, local, T, replace(config, orb=orb))
    T_drawn = _refine(observed, local, registration, wide, config).T_world_camera
    drawn = _matches(observed, local, T_drawn, config)
    if len(drawn) <= len(matches):
        return registration, matches
    level = local.voxels.levels[-1]
    return linearise(observed.cloud, level, T_drawn, config.registration), drawn


def _matches(
    observed: Observed, local: LocalMap, T: NDArray[np.float64], config: TrackingConfig
) -> Matches:
    landmarks = local.context.landmarks
    return match_by_projection(observed.features, landmarks, T, observed.intrinsics, config.orb)


def _refine(
    observed: Observed,
    local: LocalMap,
    registration: Registration,
    matches: Matches,
    config: TrackingConfig,
) -> Refinement:
    """Minimise the errors of features and registration together."""
    settings = config.refinement
    observations = pose_observations(observed.features, local.context.landmarks, matches, settings)
    T = registration.T_world_camera
    return refine_pose(observations, registration, T, observed.intrinsics, settings)
