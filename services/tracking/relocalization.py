"""Pose recovery: keyframes that look alike, features matched without a pose, PnP inside RANSAC."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import OrbConfig, RelocalizationConfig, TrackingConfig
from services.tracking.estimate import Estimate, attempt
from services.tracking.keyframes import thumbnail_of
from services.tracking.local_map import MapSource
from services.tracking.matching import match_by_descriptor
from services.tracking.observed import Observed
from services.tracking.orb import Features
from services.tracking.stopwatch import Stopwatch
from shared.camera import Intrinsics
from shared.se3 import from_rotation, inverse
from shared.tracks import Candidate, CandidatesRequest, Landmarks


@dataclass(frozen=True)
class Recovery:
    """A frame to be found somewhere in the map, and what it takes to believe a pose."""

    observed: Observed
    source: MapSource
    config: TrackingConfig
    clock: Stopwatch
    is_believed: Callable[[Estimate], bool]
    T_world_prior: NDArray[np.float64] | None = None  # [4, 4], where the camera is thought to be


@dataclass(frozen=True)
class Recovered:
    """The first pose that is believed, or the best of those that are not; None without any."""

    estimate: Estimate | None
    is_believed: bool
    num_keyframes: int  # that were compared


def is_found(observed: Observed, estimate: Estimate, config: TrackingConfig) -> bool:
    """Beyond doubt without any idea of where the camera was: many features, or some all over."""
    verification, limits = config.verification, config.relocalization
    is_spread = (
        estimate.inliers >= limits.spread_inliers
        and _cells(observed, estimate) >= limits.spread_cells
    )
    return (
        (is_spread or estimate.inliers >= verification.sure_inliers)
        and estimate.inlier_share >= verification.min_inlier_share
        and estimate.agreement.share >= verification.sure_agreement
    )


def is_found_by_colour(observed: Observed, estimate: Estimate, config: TrackingConfig) -> bool:
    """The same where no depth can refute: the same chair elsewhere must not be enough."""
    limits = config.relocalization
    return (
        estimate.inliers >= limits.spread_inliers_colour
        and estimate.inlier_share >= limits.min_inlier_share_colour
        and _cells(observed, estimate) >= limits.spread_cells
    )


def _cells(observed: Observed, estimate: Estimate) -> int:
    """How many of 4 x 4 cells of the image hold a feature that agrees."""
    size = np.array([observed.image.intrinsics.width, observed.image.intrinsics.height])
    pixels = observed.features.keypoints_px[estimate.matches.features]
    cells = np.clip((4 * pixels / size).astype(np.int64), 0, 3)
    return len(np.unique(4 * cells[:, 1] + cells[:, 0]))


def recover(recovery: Recovery) -> Recovered:
    """Ask the map for keyframes that look alike; PnP against each, then a full attempt."""
    observed, config = recovery.observed, recovery.config
    request = CandidatesRequest(
        thumbnail=thumbnail_of(observed.image.rgb),
        descriptors=observed.features.descriptors,
        limit=config.relocalization.max_candidates,
        T_world_prior=recovery.T_world_prior,
    )
    with recovery.clock.stage("relocalization"):
        candidates = recovery.source.candidates(request).keyframes
    best: Estimate | None = None
    for i, candidate in enumerate(candidates):
        for T_start in _starts(recovery, candidate, i == 0):
            local = recovery.source.local_map(candidate.seq)
            estimate = attempt(observed, local, T_start, config, recovery.clock)
            if recovery.is_believed(estimate):
                return Recovered(estimate, True, len(candidates))
            best = max(best or estimate, estimate, key=lambda e: e.inliers)
    return Recovered(best, False, len(candidates))


def _starts(
    recovery: Recovery, candidate: Candidate, is_first: bool
) -> Iterator[NDArray[np.float64]]:
    """Where to start from: what is thought, for the keyframe nearest to it, then PnP."""
    if is_first and recovery.T_world_prior is not None:
        yield recovery.T_world_prior.copy()  # compiled code wants it writable
    with recovery.clock.stage("relocalization"):
        T_world_camera = locate(
            recovery.observed.features,
            candidate.landmarks,
            recovery.observed.image.intrinsics,
            recovery.config.orb,
            recovery.config.relocalization,
        )
    if T_world_camera is not None:
        yield T_world_camera


def locate(
    features: Features,
    landmarks: Landmarks,
    intrinsics: Intrinsics,
    orb: OrbConfig,
    config: RelocalizationConfig,
) -> NDArray[np.float64] | None:
    """T_world_camera by matching descriptors and PnP, or None where too few agree.

    MAGSAC keeps its speed with 70 to 85 % of wrong matches, which P3P does not (measured).
    """
    matches = match_by_descriptor(features, landmarks, orb)
    if len(matches) < config.min_matches:
        return None
    return _solve_pnp(
        landmarks.positions_world[matches.landmarks],
        features.keypoints_px[matches.features].astype(np.float64),
        intrinsics,
        config,
    )


def _solve_pnp(
    points_world: NDArray[np.float64],
    keypoints_px: NDArray[np.float64],
    intrinsics: Intrinsics,
    config: RelocalizationConfig,
) -> NDArray[np.float64] | None:
    cv2.setRNGSeed(config.seed)
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points_world,
            keypoints_px,
            intrinsics.matrix(),
            np.zeros(4),
            iterationsCount=config.iterations,
            reprojectionError=config.reprojection_px,
            confidence=0.999,
            flags=cv2.USAC_MAGSAC,
        )
    except cv2.error:  # degenerate points: no pose from these
        return None
    if not found or inliers is None or len(inliers) < config.min_inliers:
        return None
    T_camera_world = from_rotation(cv2.Rodrigues(rotation)[0], np.ravel(translation))
    return inverse(T_camera_world) if np.isfinite(T_camera_world).all() else None
