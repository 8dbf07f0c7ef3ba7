"""Progressive pose optimization: one frame in, one pose out (paper, section of that name).

`track` is a function of the frame, the prior and the map's answers. Nothing is remembered here:
whichever worker gets the frame gives the same result to the bit.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TrackingConfig
from services.tracking.estimate import Estimate, is_well_known, pose_covariance
from services.tracking.executors import NoHelper, taken_over
from services.tracking.keyframes import (
    Coverage,
    KeyframeLooks,
    becomes_keyframe,
    is_too_blurred,
    keyframe_data,
    keyframe_looks,
    keyframe_observations,
    nearest_reference,
    sharpness_of,
    with_moving,
)
from services.tracking.local_map import LocalMap, MapSource
from services.tracking.loop_verification import find_loop
from services.tracking.observed import EncodedImages, Observed, observe
from services.tracking.prediction import brought_up
from services.tracking.search import Found, Job, search
from services.tracking.stopwatch import Stopwatch
from services.tracking.verification import step_between
from services.tracking.window import AdjustedKeyframe, NewKeyframe, adjust_window, first_correction
from shared.frames import Prior, TrackingStatus, TrackRequest
from shared.pixel_cells import cells_of
from shared.se3 import inverse
from shared.tracks import (
    NO_LANDMARK,
    KeyframeData,
    KeyframeLink,
    LoopConstraint,
    Observations,
    TrackResult,
)

_ALONE = NoHelper()


def track(
    request: TrackRequest,
    source: MapSource,
    config: TrackingConfig,
    helper: Executor = _ALONE,
) -> TrackResult:
    """Estimate the pose of one frame and, where the map needs it, make it a keyframe.

    Args:
        request: the frame with its calibration and everything known before it.
        source: answers of the map's owner in the request's revision.
        config: all numbers.
        helper: a thread for what can be done beside; the result is the same without.

    Raises:
        InputError: an image cannot be decoded; names the field.
    """
    clock = Stopwatch()
    images = EncodedImages(request.frame.rgb, request.frame.depth, request.calibration)
    observed = observe(images, config, clock, helper)
    job = Job(request, observed, source, config, clock)
    if not job.is_predictable:
        observed.find_finest()  # wanted first, and the map may still be on its way
    with clock.stage("context"):
        local = source.local_map(request.prior.reference_seq if request.prior else -1)
    if local.context.num_keyframes == 0:
        return _begin(job)
    job = _brought_up(job, local)
    found = search(job, local)
    if found.estimate is None:
        return _lost(job, local)
    job = replace(job, observed=found.observed)
    with clock.stage("keyframe"):
        keyframe = _new_keyframe(job, found, helper)
    return _answer(job, found, keyframe)


def _brought_up(job: Job, local: LocalMap) -> Job:
    """The job with its prior in the map as it is now."""
    if job.request.prior is None:
        return job
    prior = brought_up(job.request.prior, local.context)
    return replace(job, request=replace(job.request, prior=prior))


def _begin(job: Job) -> TrackResult:
    """The first frame of a map holds the world in place."""
    request, observed = job.request, job.observed
    T = request.T_world_first
    enough = len(observed.cloud.points) >= job.config.keyframe.min_points
    is_first = request.prior is None  # a later one waits for the map to show what it began with
    if not (is_first and request.frame.may_be_keyframe and enough):
        return _without_pose(job, TrackingStatus.NEED_FRAMES, T, -1)
    seq = request.frame.seq
    none = np.full(len(observed.features.octaves), NO_LANDMARK, np.int64)
    observations = keyframe_observations(seq, observed.features, none)
    correction = first_correction(seq, T, observations, observed.intrinsics)
    data = keyframe_data(_looks(job, observations), observations, correction)
    return TrackResult(
        seq=seq,
        t_ns=request.frame.t_ns,
        status=TrackingStatus.TRACKED,
        T_world_camera=T,
        covariance=np.zeros((6, 6)),
        reference_seq=seq,
        T_reference_camera=np.eye(4),
        inliers=0,
        inlier_share=0.0,
        map_revision=request.map_revision,
        timings_ms=job.clock.times(),
        keyframe=data,
    )


def _lost(job: Job, local: LocalMap) -> TrackResult:
    """The prior's pose again, said to be lost; as any other it goes along with its keyframe."""
    prior, context = job.request.prior, local.context
    T = context.T_world_reference if prior is None else prior.T_world_camera
    lost = _without_pose(job, TrackingStatus.LOST, T, context.reference_seq)
    return replace(lost, T_reference_camera=inverse(context.T_world_reference) @ T)


def _without_pose(
    job: Job, status: TrackingStatus, T: NDArray[np.float64], reference_seq: int
) -> TrackResult:
    frame = job.request.frame
    return TrackResult(
        seq=frame.seq,
        t_ns=frame.t_ns,
        status=status,
        T_world_camera=T,
        covariance=np.zeros((6, 6)),
        reference_seq=reference_seq,
        T_reference_camera=np.eye(4),
        inliers=0,
        inlier_share=0.0,
        map_revision=job.request.map_revision,
        timings_ms=job.clock.times(),
    )


def _new_keyframe(job: Job, found: Found, helper: Executor) -> KeyframeData | None:
    """What the frame brings to the map, or None where the map has no need of it."""
    estimate, observed, config = found.estimate, job.observed, job.config
    assert estimate is not None
    frame, prior = job.request.frame, job.request.prior
    if prior is None or found.status is TrackingStatus.RELOCALISED:
        return None
    coverage = _coverage(observed, estimate, prior)
    if not is_well_known(estimate, config):
        return None
    if not becomes_keyframe(frame, prior, coverage, config.keyframe):
        return None
    ids = estimate.landmark_ids(len(observed.features.octaves))
    observations = keyframe_observations(frame.seq, observed.features, ids)
    observations = with_moving(observations, observed.moving)
    loop_search = helper.submit(_loop, job, estimate, observations)
    look = partial(_looks, job, observations)
    looking = helper.submit(look)
    with job.clock.stage("bundle_adjustment"):
        adjusted = _adjusted(job, estimate, observations)
    looks = taken_over(looking, look)  # the search for a loop may take longer than the window
    loop = loop_search.result()
    sharpness = sharpness_of(looks.edge_blur_px, estimate.local.context.window)
    if is_too_blurred(sharpness, coverage, observed.intrinsics, config.keyframe):
        return None
    data = keyframe_data(looks, adjusted.observations, adjusted.correction)
    cells = None if observed.is_moving is None else cells_of(observed.is_moving)
    return replace(data, link=_link(estimate), moving_cells=cells, loop=loop)


def _adjusted(job: Job, estimate: Estimate, observations: Observations) -> AdjustedKeyframe:
    """The keyframe with its window adjusted to it."""
    seq, T = job.request.frame.seq, estimate.T_world_camera
    new = NewKeyframe(seq, T, observations, estimate.registration)
    return adjust_window(new, estimate.local.context, job.observed.intrinsics, job.config)


def _link(estimate: Estimate) -> KeyframeLink:
    """How firmly the keyframe hangs on the one it was tracked in."""
    context = estimate.local.context
    return KeyframeLink(context.reference_seq, context.revision, estimate.information)


def _looks(job: Job, observations: Observations) -> KeyframeLooks:
    """What the frame shows to a map, wherever its window places it."""
    image, cloud = job.observed.image, job.observed.cloud
    with job.clock.stage("looks"):
        return keyframe_looks(image, cloud, observations.keypoints_px, job.config)


def _loop(job: Job, estimate: Estimate, observations: Observations) -> LoopConstraint | None:
    """An earlier keyframe of the same place."""
    with job.clock.stage("loop"):
        return find_loop(job, estimate, observations)


def _coverage(observed: Observed, estimate: Estimate, prior: Prior) -> Coverage:
    is_known = observed.features.depths_m > 0.0
    is_known[estimate.matches.features] = True
    T_world_reference = estimate.local.context.T_world_reference
    return Coverage(
        num_points=len(observed.cloud.points),
        overlap=estimate.registration.overlap,
        landmarks=estimate.inliers,
        landmark_share=estimate.inliers / max(1, int(is_known.sum())),
        T_reference_camera=inverse(T_world_reference) @ estimate.T_world_camera,
        median_depth_m=_median_depth(observed),
        step_deg=step_between(prior.T_world_camera, estimate.T_world_camera).degrees,
        waiting=int((observed.features.is_unmeasured & ~is_known).sum()),
    )


def _median_depth(observed: Observed) -> float:
    depths = observed.cloud.points[::8, 2]
    return float(np.median(depths)) if len(depths) else 1.0


def _answer(job: Job, found: Found, keyframe: KeyframeData | None) -> TrackResult:
    estimate, frame = found.estimate, job.request.frame
    assert estimate is not None
    T = estimate.T_world_camera
    if keyframe is None:
        reference_seq, T_world_reference = _reference(job, estimate)
    else:
        T = keyframe.correction.T_world_keyframes[-1]
        reference_seq, T_world_reference = frame.seq, T
    return TrackResult(
        seq=frame.seq,
        t_ns=frame.t_ns,
        status=found.status,
        T_world_camera=T,
        covariance=pose_covariance(estimate.information, job.config),
        reference_seq=reference_seq,
        T_reference_camera=inverse(T_world_reference) @ T,
        inliers=estimate.inliers,
        inlier_share=estimate.inlier_share,
        map_revision=estimate.local.context.revision,
        timings_ms=job.clock.times(),
        keyframe=keyframe,
        T_last_camera=_motion(job, T),
    )


def _motion(job: Job, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64] | None:
    prior = job.request.prior
    return None if prior is None else inverse(prior.T_world_camera) @ T_world_camera


def _reference(job: Job, estimate: Estimate) -> tuple[int, NDArray[np.float64]]:
    context = estimate.local.context
    return nearest_reference(
        estimate.T_world_camera,
        (context.reference_seq, context.T_world_reference),
        [(keyframe.seq, keyframe.T_world_camera) for keyframe in context.window],
        _median_depth(job.observed),
    )
