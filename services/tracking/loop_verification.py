"""Is this the place of an earlier keyframe? A new keyframe measured in the map around that one.

The map around the earlier keyframe is made of what is near to it in the graph, so the pose found
in it owes nothing to the drift since then.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import LoopVerificationConfig
from services.tracking.estimate import Estimate
from services.tracking.local_map import LocalMap
from services.tracking.matching import match_by_descriptor
from services.tracking.registration import overlap
from services.tracking.search import Job
from services.tracking.verification import Step, step_between
from shared.se3 import inverse
from shared.tracks import LoopConstraint, Observations


def find_loop(job: Job, estimate: Estimate, observations: Observations) -> LoopConstraint | None:
    """The first of the context's loop candidates that features and depth confirm.

    Args:
        job: the frame.
        estimate: its pose as tracked, and the context that names the candidates.
        observations: of the keyframe that it becomes.
    """
    for seq in estimate.local.context.loop_seqs[: job.config.loop.max_candidates]:
        local = job.source.loop_map(int(seq))
        there = None if local is None else _measure(job, estimate, local)
        if there is not None:
            return _constraint(there, observations)
    return None


def _measure(job: Job, estimate: Estimate, local: LocalMap) -> Estimate | None:
    """The frame in the map around a candidate: where it is by now, or else where features say."""
    config = job.config.loop
    here = _measure_as_tracked(job, estimate, local)
    if here is not None:
        return here
    T_located = job.locate(local) if _looks_alike(job, local) else None
    if T_located is None:
        return None
    there = job.attempt(local, T_located)
    return there if is_confirmed(there, config) else None


def _measure_as_tracked(job: Job, estimate: Estimate, local: LocalMap) -> Estimate | None:
    """The frame about where it is by now.

    Most candidates see something else: at a glance that shows in a tenth of the time that an
    attempt takes, and a drift within the coarsest voxels changes nothing.
    """
    T, config = estimate.T_world_camera, job.config.loop
    if overlap(job.observed.cloud, local.glance, T, job.config.registration) < config.min_overlap:
        return None
    here = job.attempt(local, T)
    is_believed = is_confirmed(here, config) or is_unmoved(here, estimate, config)
    return here if is_believed else None


def _looks_alike(job: Job, local: LocalMap) -> bool:
    """Whether enough of the best features are landmarks there, so that a search may succeed."""
    config = job.config.loop
    best = job.observed.features.first(config.compared_features)
    matches = match_by_descriptor(best, local.context.landmarks, job.config.orb)
    return len(matches) >= config.min_alike


def is_confirmed(there: Estimate, config: LoopVerificationConfig) -> bool:
    """Features say that it is the place, and depth does not refute it."""
    return (
        there.inliers >= config.min_inliers
        and there.inlier_share >= config.min_inlier_share
        and there.agreement.share >= config.min_agreement
        and there.registration.overlap >= config.min_overlap
    )


def is_unmoved(there: Estimate, estimate: Estimate, config: LoopVerificationConfig) -> bool:
    """Geometry alone says so, about where the frame is by its odometry.

    Directions that the geometry leaves open keep that pose; the information says how open.
    """
    limit = Step(config.unmoved_m, config.unmoved_deg)
    return (
        there.agreement.share >= config.unmoved_min_agreement
        and there.registration.overlap >= config.unmoved_min_overlap
        and step_between(estimate.T_world_camera, there.T_world_camera).is_within(limit)
    )


def _constraint(there: Estimate, observations: Observations) -> LoopConstraint:
    context = there.local.context
    return LoopConstraint(
        earlier_seq=context.reference_seq,
        T_earlier_keyframe=inverse(context.T_world_reference) @ there.T_world_camera,
        information=there.information,
        landmark_ids=_same_points(there, observations),
    )


def _same_points(there: Estimate, observations: Observations) -> NDArray[np.int64]:
    """Landmarks of the earlier map beside the keyframe's own for the same feature, [P, 2]."""
    features, landmarks = there.matches.features, there.matches.landmarks
    own = observations.landmark_ids[features]
    earlier = there.local.context.landmarks.ids[landmarks]
    keep = (own >= 0) & (own != earlier)
    return np.column_stack([earlier[keep], own[keep]])
