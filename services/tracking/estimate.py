"""One attempt at a frame's pose: registration, features, refinement, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass

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

_SAME_M = 5e-4
_SAME_RAD = 5e-4


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
    registration: Registration  # linearised at the refined pose


def _refine_until_still(
    observed: Observed, local: LocalMap, registration: Registration, config: TrackingConfig
) -> _Refined:
    """Refine; where that moved the pose, find matches and correspondences anew and repeat."""
    refined = _refine(observed, local, registration, config)
    for _ in range(config.refinement.max_relinearisations - 1):
        step = inverse(registration.T_world_camera) @ refined.refinement.T_world_camera
        if _is_small(step):
            break
        registration = refined.registration
        refined = _refine(observed, local, registration, config)
    return refined


def _is_small(step: NDArray[np.float64]) -> bool:
    """Whether correspondences would stay the same after this step."""
    return float(np.linalg.norm(step[:3, 3])) < _SAME_M and angle_rad(step) < _SAME_RAD


def _refine(
    observed: Observed, local: LocalMap, registration: Registration, config: TrackingConfig
) -> _Refined:
    """Match around a registered pose and minimise both errors together."""
    landmarks = local.context.landmarks
    T, intrinsics = registration.T_world_camera, observed.intrinsics
    matches = match_by_projection(observed.features, landmarks, T, intrinsics, config.orb)
    observations = pose_observations(observed.features, landmarks, matches, config.refinement)
    refinement = refine_pose(observations, registration, T, intrinsics, config.refinement)
    finest = local.voxels.levels[-1]
    return _Refined(
        refinement,
        matches,
        linearise(observed.cloud, finest, refinement.T_world_camera, config.registration),
    )
