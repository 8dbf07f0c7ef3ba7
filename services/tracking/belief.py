"""How far an estimate is believed by its own evidence: features, depth, the map, the prediction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import VerificationConfig
from services.tracking.estimate import Estimate
from services.tracking.verification import Step, step_between


def is_near(
    estimate: Estimate, T_predicted: NDArray[np.float64], config: VerificationConfig
) -> bool:
    """Not far from where it was expected."""
    near = Step(config.near_step_m, config.near_step_deg)
    return step_between(T_predicted, estimate.T_world_camera).is_within(near)


def is_sure(estimate: Estimate, config: VerificationConfig) -> bool:
    """Features and depth agree so well that nothing else needs to be tried."""
    return estimate.inliers >= config.sure_inliers and _agrees(estimate, config)


def is_as_predicted(
    estimate: Estimate, T_predicted: NDArray[np.float64], config: VerificationConfig
) -> bool:
    """About where it was expected, which takes fewer features to be sure of."""
    return (
        estimate.inliers >= config.sure_inliers_near
        and is_near(estimate, T_predicted, config)
        and _agrees(estimate, config)
    )


def _agrees(estimate: Estimate, config: VerificationConfig) -> bool:
    return (
        estimate.agreement.share >= config.sure_agreement
        and estimate.inlier_share >= config.min_inlier_share
    )


def is_confirmed(
    estimate: Estimate, T_predicted: NDArray[np.float64], config: VerificationConfig
) -> bool:
    """Features confirm the pose and depth does not refute it.

    A few features agree with the next diamond of a carpet too, but there part of the surface does
    not: where they are few and the pose is not as expected, depth must agree as well.
    """
    may_be_alias = estimate.inliers < config.sure_inliers and not is_near(
        estimate, T_predicted, config
    )
    least = config.sure_agreement if may_be_alias else config.min_agreement
    return (
        estimate.inliers >= config.min_inliers
        and estimate.inlier_share >= config.min_inlier_share
        and estimate.agreement.share >= least
        and estimate.registration.overlap >= config.min_overlap
    )


def is_only_seen(estimate: Estimate, config: VerificationConfig) -> bool:
    """An image without depth: its features alone hold the pose."""
    return (
        estimate.agreement.is_silent
        and estimate.inliers >= config.sure_inliers_near
        and estimate.inlier_share >= config.seen_min_inlier_share
    )


def is_coarse(
    estimate: Estimate, T_predicted: NDArray[np.float64], config: VerificationConfig
) -> bool:
    """Geometry alone holds the pose, about where it was expected.

    Directions that the geometry leaves open keep the prediction; the covariance says how open.
    """
    limit = Step(config.coarse_max_step_m, config.coarse_max_step_deg)
    near = is_near(estimate, T_predicted, config)
    least = config.coarse_min_overlap if near else config.coarse_min_overlap_far
    return (
        estimate.agreement.share >= config.coarse_min_agreement
        and estimate.registration.overlap >= least
        and step_between(T_predicted, estimate.T_world_camera).is_within(limit)
    )
