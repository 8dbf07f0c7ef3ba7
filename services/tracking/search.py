"""The search for a frame's pose: prediction first, features without a pose next, the map last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.tracking.absolute_orientation import locate_by_points
from services.tracking.belief import (
    is_as_predicted,
    is_coarse,
    is_confirmed,
    is_near,
    is_only_seen,
    is_sure,
)
from services.tracking.config import TrackingConfig, VerificationConfig
from services.tracking.estimate import Estimate, attempt, is_well_known
from services.tracking.local_map import LocalMap, MapSource
from services.tracking.moving import find_moving, known_moving
from services.tracking.observed import Observed
from services.tracking.prediction import is_predictable, predict, turned_starts
from services.tracking.registration import overlap
from services.tracking.relocalization import Recovery, is_found, locate, recover
from services.tracking.stopwatch import Stopwatch
from services.tracking.verification import is_possible_step
from shared.frames import Prior, TrackingStatus, TrackRequest


@dataclass(frozen=True)
class Job:
    """One frame on its way through the pipeline."""

    request: TrackRequest
    observed: Observed
    source: MapSource
    config: TrackingConfig
    clock: Stopwatch

    @property
    def is_predictable(self) -> bool:
        """Whether the camera is expected near enough to a known place to start from there."""
        prior, config = self.request.prior, self.config.verification
        return prior is not None and is_predictable(prior, self.request.frame, config)

    @property
    def T_predicted(self) -> NDArray[np.float64]:
        """Where the camera is expected, [4, 4]; of a frame with a prior."""
        assert self.request.prior is not None
        return predict(self.request.prior, self.request.frame)

    def attempt(self, local: LocalMap, T_start: NDArray[np.float64]) -> Estimate:
        """Register and refine from one starting pose."""
        return attempt(self.observed, local, T_start, self.config, self.clock)

    def locate(self, local: LocalMap) -> NDArray[np.float64] | None:
        """Pose from features alone."""
        with self.clock.stage("relocalization"):
            return locate(
                self.observed.features,
                local.context.landmarks,
                self.observed.intrinsics,
                self.config.orb,
                self.config.relocalization,
            )

    def locate_nearby(self, local: LocalMap) -> NDArray[np.float64] | None:
        """Pose from features with depth: sooner than `locate`, and good enough to start from."""
        with self.clock.stage("wait"):
            self.observed.wait()
        with self.clock.stage("feature_start"):
            return locate_by_points(
                self.observed.features,
                local.context.landmarks,
                self.observed.intrinsics,
                self.config,
            )


@dataclass(frozen=True)
class Found:
    """The outcome of a search; without an estimate the camera is lost."""

    status: TrackingStatus
    estimate: Estimate | None
    observed: Observed  # without what moves


def search(job: Job, local: LocalMap) -> Found:
    """Find the pose: nearby, then among the keyframes that look alike.

    Where geometry alone leaves the pose open, a place that is known beyond doubt goes first.
    """
    job = _without_known(job, local)
    nearby = _search_nearby(job, local)
    if nearby.status is TrackingStatus.TRACKED or _is_held(nearby, job.config):
        return nearby
    elsewhere = _relocalise(job)
    return elsewhere if elsewhere.estimate is not None else nearby


def _is_held(found: Found, config: TrackingConfig) -> bool:
    """Whether a pose is known well enough to go on from."""
    return found.estimate is not None and is_well_known(found.estimate, config)


def _search_nearby(job: Job, local: LocalMap) -> Found:
    """The best of the attempts around the prior, if it is believed."""
    best = _best_nearby(job, local)
    if best is None:
        return Found(TrackingStatus.LOST, None, job.observed)
    job, best = _without_moving(job, local, best)
    status = _status(job, best)
    return Found(status, None if status is TrackingStatus.LOST else best, job.observed)


def _without_known(job: Job, local: LocalMap) -> Job:
    """The job without what the keyframes around know to go with the camera."""
    with job.clock.stage("moving"):
        moving = known_moving(job.observed, local, job.config.moving)
        return job if moving is None else replace(job, observed=job.observed.without(moving))


def _without_moving(job: Job, local: LocalMap, estimate: Estimate) -> tuple[Job, Estimate]:
    """The job and its estimate, without what moves otherwise than the map where there is such."""
    config = job.config.moving
    with job.clock.stage("moving"):
        moving = find_moving(job.observed, local, estimate.T_world_camera, config)
        if moving is None:
            return job, estimate
        rest = replace(job, observed=job.observed.without(moving.mask))
    found = _best(rest, [rest.attempt(local, T) for T in _starts_around(job, estimate)])
    if not moving.is_confirmed(found.T_world_camera, job.observed, config):
        return job, estimate
    return rest, found


def _best_nearby(job: Job, local: LocalMap) -> Estimate | None:
    """The first attempt that is beyond doubt ends the search; None without a prior."""
    prior = job.request.prior
    if prior is None:
        return None
    predicted = job.T_predicted
    tried: list[Estimate] = []
    for T_start in _starts(job, local, prior, predicted):
        tried.append(job.attempt(local, T_start))
        if _is_enough(job, tried[-1], predicted):
            return tried[-1]
    best = _best(job, tried)
    if prior.lost_frames > 0 or not _is_doubtful(best, predicted, job.config.verification):
        return best
    turned = turned_starts(predicted, job.config.registration.turn_deg)
    return _best(job, [best, *(job.attempt(local, T) for T in turned)])


def _starts(
    job: Job, local: LocalMap, prior: Prior, T_predicted: NDArray[np.float64]
) -> Iterator[NDArray[np.float64]]:
    """As predicted, where features say, where it was; in large steps features come first."""
    T_located = None if job.is_predictable else job.locate_nearby(local)
    if T_located is not None:
        yield T_located
    yield T_predicted
    if T_located is None and (T_located := job.locate(local)) is not None:
        yield T_located
    yield prior.T_world_camera.copy()


def _is_enough(job: Job, estimate: Estimate, T_predicted: NDArray[np.float64]) -> bool:
    """Nothing else needs to be tried."""
    config = job.config.verification
    if is_as_predicted(estimate, T_predicted, config) or is_only_seen(estimate, config):
        return True
    is_beyond_doubt = is_found(job.observed, estimate, job.config)
    return is_beyond_doubt and _is_explained(job, estimate, T_predicted)


def _is_explained(job: Job, estimate: Estimate, T_predicted: NDArray[np.float64]) -> bool:
    """Whether the map has as much of the frame as it would have from where it was expected.

    On a pattern that repeats itself, features may agree with a place one period away; surfaces
    that the map has from the right place are then missing.
    """
    config, voxels = job.config.registration, estimate.local.voxels.levels[0]

    def share(T_world_camera: NDArray[np.float64]) -> float:
        return overlap(job.observed.cloud, voxels, T_world_camera, config)

    least = share(T_predicted) - job.config.verification.max_unexplained
    return estimate.registration.overlap >= least or share(estimate.T_world_camera) >= least


def _starts_around(job: Job, estimate: Estimate) -> list[NDArray[np.float64]]:
    """Where the camera was expected, and where it was found if that is elsewhere."""
    predicted = job.T_predicted
    if is_near(estimate, predicted, job.config.verification):
        return [predicted]
    return [predicted, estimate.T_world_camera]


def _is_doubtful(
    estimate: Estimate, T_predicted: NDArray[np.float64], config: VerificationConfig
) -> bool:
    """Not confirmed, not where it was expected, and depth does not fit the map all over.

    What geometry leaves open stays at the start: a turned start that fits no better spoils it.
    """
    is_expected = is_near(estimate, T_predicted, config) and is_coarse(
        estimate, T_predicted, config
    )
    is_explained = (
        estimate.agreement.share >= config.explained_min_agreement
        and estimate.registration.overlap >= config.explained_min_overlap
    )
    is_settled = is_confirmed(estimate, T_predicted, config) or is_expected or is_explained
    return not (is_settled or estimate.agreement.is_silent)


def _best(job: Job, estimates: list[Estimate]) -> Estimate:
    """One that is confirmed before one that is not, whatever that has for itself."""
    T_predicted, config = job.T_predicted, job.config.verification
    return max(estimates, key=lambda e: (is_confirmed(e, T_predicted, config), e.score))


def _status(job: Job, estimate: Estimate) -> TrackingStatus:
    """How far an estimate near the prior is believed."""
    prior, config = job.request.prior, job.config.verification
    assert prior is not None
    is_possible = is_possible_step(
        prior.T_world_camera, estimate.T_world_camera, 1 + prior.lost_frames, config
    )
    if prior.lost_frames > 0:
        is_back = is_possible and _is_back(job, estimate, prior.lost_frames)
        return TrackingStatus.TRACKED if is_back else TrackingStatus.LOST
    T_predicted = job.T_predicted
    if is_confirmed(estimate, T_predicted, config) and (is_possible or is_sure(estimate, config)):
        return TrackingStatus.TRACKED
    if is_coarse(estimate, T_predicted, config) or (is_possible and is_only_seen(estimate, config)):
        return TrackingStatus.COARSE_ONLY
    return TrackingStatus.LOST


def _is_back(job: Job, estimate: Estimate, lost_frames: int) -> bool:
    """After a break: where most of what is seen is known, and after a long one beyond doubt.

    A repeated object agrees as well as the right one, among surroundings that the map lacks.
    """
    config = job.config.verification
    if lost_frames > config.brief_lost_frames:
        return is_found(job.observed, estimate, job.config)
    return (
        is_confirmed(estimate, job.T_predicted, config)
        and estimate.agreement.share >= config.sure_agreement
        and estimate.registration.overlap >= config.explained_min_overlap
    )


def _relocalise(job: Job) -> Found:
    """Find the camera anywhere in the map; a frame after the break must be beyond doubt."""
    recovered = recover(
        Recovery(
            observed=job.observed,
            source=job.source,
            config=job.config,
            clock=job.clock,
            is_believed=lambda estimate: is_found(job.observed, estimate, job.config),
        )
    )
    if recovered.is_believed:
        return Found(TrackingStatus.RELOCALISED, recovered.estimate, job.observed)
    return Found(TrackingStatus.LOST, None, job.observed)
