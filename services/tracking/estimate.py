"""One attempt at a frame's pose: registration, features, refinement, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TrackingConfig
from services.tracking.least_squares import Refinement, pose_observations, refine_pose
from services.tracking.local_map import LocalMap
from services.tracking.matching import Matches, match_by_projection
from services.tracking.orb import Features
from services.tracking.registration import Registration, align, linearise
from services.tracking.stopwatch import Stopwatch
from services.tracking.verification import Agreement, depth_agreement
from shared.rectify import RgbdImage
from shared.se3 import angle_rad, inverse
from shared.tracks import NO_LANDMARK, PointCloud

_SAME_M = 5e-4
_SAME_RAD = 5e-4


@dataclass(frozen=True)
class Observed:
    """What one frame shows."""

    image: RgbdImage
    cloud: PointCloud  # camera frame
    features: Features


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
        return evidence * self.agreement.share**2

    def landmark_ids(self, num_features: int) -> NDArray[np.int64]:
        """Landmark of each feature of the frame, NO_LANDMARK where none, [M]."""
        ids = np.full(num_features, NO_LANDMARK, np.int64)
        ids[self.matches.features] = self.local.context.landmarks.ids[self.matches.landmarks]
        return ids


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
    with clock.stage("refine"):
        for _ in range(config.refinement.max_relinearisations):
            refinement, matches = _refine(observed, local, registration, config)
            step = inverse(registration.T_world_camera) @ refinement.T_world_camera
            registration = linearise(
                observed.cloud,
                local.voxels.levels[-1],
                refinement.T_world_camera,
                config.registration,
            )
            if _is_small(step):
                break
        agreement = depth_agreement(
            observed.image,
            local.context.cloud_world,
            registration.T_world_camera,
            config.verification,
        )
    return Estimate(
        T_world_camera=refinement.T_world_camera,
        information=refinement.information,
        registration=registration,
        agreement=agreement,
        matches=matches.where(refinement.is_inlier),
        num_matches=len(matches),
        local=local,
    )


def _is_small(step: NDArray[np.float64]) -> bool:
    """Whether correspondences would stay the same after this step."""
    return float(np.linalg.norm(step[:3, 3])) < _SAME_M and angle_rad(step) < _SAME_RAD


def _refine(
    observed: Observed, local: LocalMap, registration: Registration, config: TrackingConfig
) -> tuple[Refinement, Matches]:
    """Match around a registered pose and minimise both errors together."""
    landmarks = local.context.landmarks
    T, intrinsics = registration.T_world_camera, observed.image.intrinsics
    matches = match_by_projection(observed.features, landmarks, T, intrinsics, config.orb)
    observations = pose_observations(observed.features, landmarks, matches, config.refinement)
    return refine_pose(observations, registration, T, intrinsics, config.refinement), matches
