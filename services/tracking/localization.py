"""One image found in a map that exists: no session of frames, no memory, nothing is changed."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from services.tracking.config import TrackingConfig
from services.tracking.estimate import Estimate, pose_covariance
from services.tracking.executors import NoHelper
from services.tracking.local_map import MapSource
from services.tracking.observed import EncodedImages, Observed, observe
from services.tracking.relocalization import (
    Recovered,
    Recovery,
    is_found,
    is_found_by_colour,
    recover,
)
from services.tracking.stopwatch import Stopwatch
from shared.localization import LocalizationStatus, LocalizeRequest, LocalizeResult

_ALONE = NoHelper()


def localize(
    request: LocalizeRequest,
    source: MapSource,
    config: TrackingConfig,
    helper: Executor = _ALONE,
) -> LocalizeResult:
    """Find the pose of one image anywhere in a map; a pure function like `track`.

    With depth the pose must fit the surfaces of the map; without, more features must agree, spread
    over the image, and the answer says COLOUR_ONLY.

    Args:
        request: the image with its calibration, and where it is thought to be, if anywhere.
        source: answers of the map's owner in the request's revision.
        config: all numbers.
        helper: a thread for what can be done beside; the result is the same without.

    Raises:
        InputError: an image cannot be decoded; names the field.
    """
    clock = Stopwatch()
    images = EncodedImages(request.rgb, request.depth, request.calibration)
    observed = observe(images, config, clock, helper)
    has_depth = request.depth is not None
    is_believed = is_found if has_depth else is_found_by_colour
    recovered = recover(
        Recovery(
            observed=observed,
            source=source,
            config=config,
            clock=clock,
            is_believed=lambda estimate: is_believed(observed, estimate, config),
            T_world_prior=request.T_world_prior,
        )
    )
    if not recovered.is_believed or recovered.estimate is None:
        return _refusal(request, _reason(observed, recovered), clock)
    found = LocalizationStatus.LOCALISED if has_depth else LocalizationStatus.COLOUR_ONLY
    return _answer(found, recovered.estimate, clock.times(), config)


def _answer(
    status: LocalizationStatus,
    estimate: Estimate,
    timings_ms: dict[str, float],
    config: TrackingConfig,
) -> LocalizeResult:
    return LocalizeResult(
        status=status,
        reason="",
        T_world_camera=estimate.T_world_camera,
        covariance=pose_covariance(estimate.information, config),
        inliers=estimate.inliers,
        inlier_share=estimate.inlier_share,
        reference_seq=estimate.local.context.reference_seq,
        map_revision=estimate.local.context.revision,
        timings_ms=timings_ms,
    )


def _refusal(request: LocalizeRequest, reason: str, clock: Stopwatch) -> LocalizeResult:
    return LocalizeResult(
        status=LocalizationStatus.NOT_LOCALISED,
        reason=reason,
        T_world_camera=np.eye(4),
        covariance=np.zeros((6, 6)),
        inliers=0,
        inlier_share=0.0,
        reference_seq=-1,
        map_revision=request.map_revision,
        timings_ms=clock.times(),
    )


def _reason(observed: Observed, recovered: Recovered) -> str:
    """Why no pose is believed, for people."""
    if recovered.num_keyframes == 0:
        return "the map has no keyframes yet"
    num_features = len(observed.features.octaves)
    if num_features < 100:
        return f"the image has too little texture: {num_features} features"
    best = recovered.estimate
    if best is None:
        return "no keyframe looks like this"
    return (
        f"the keyframe most alike ({best.local.context.reference_seq}) does not confirm it: "
        f"{best.inliers} features agree, {100 * best.agreement.share:.0f} % of the map's surface"
    )
