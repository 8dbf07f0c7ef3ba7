"""A new keyframe measured in the map around an earlier one."""

from dataclasses import replace

import numpy as np

from services.tracking.executors import NoHelper
from services.tracking.keyframes import keyframe_observations
from services.tracking.local_map import LocalMap
from services.tracking.loop_verification import find_loop
from services.tracking.observed import EncodedImages, observe
from services.tracking.search import Job
from services.tracking.stopwatch import Stopwatch
from shared.se3 import angle_rad, exp, inverse
from shared.tracks import NO_LANDMARK, LoopConstraint

HERE = exp([0.05, -0.02, 0.04, 0.01, 0.03, 0.0])
DRIFT = exp([0.5, 0.1, -0.4, 0.0, 0.5, 0.0])
BEHIND = exp([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])


def loop_seen_from(
    room, session, source_of, pose: np.ndarray, drift: np.ndarray = DRIFT
) -> LoopConstraint | None:
    """What a keyframe at a pose finds of the first one, with drift in its odometry."""
    session.track(room.frame(0, np.eye(4)))
    source, frame = source_of(session.store, session.config), room.frame(9, pose)
    images = EncodedImages(frame.rgb, frame.depth, session.calibration)
    observed = observe(images, session.config, Stopwatch(), NoHelper())
    job = Job(session.request(frame), observed, source, session.config, Stopwatch())
    local = source.local_map(0)
    named = LocalMap(replace(local.context, loop_seqs=np.array([0])), local.config)
    estimate = replace(job.attempt(named, pose), T_world_camera=drift @ pose)
    none = np.full(len(observed.features.octaves), NO_LANDMARK, np.int64)
    return find_loop(job, estimate, keyframe_observations(9, observed.features, none))


def test_a_keyframe_finds_its_place_by_features_where_its_odometry_is_far_off(
    room, session, source_of
):
    loop = loop_seen_from(room, session, source_of, HERE)

    assert loop is not None
    error = inverse(HERE) @ loop.T_earlier_keyframe
    assert np.linalg.norm(error[:3, 3]) < 0.003
    assert np.degrees(angle_rad(error)) < 0.1


def test_a_drift_of_a_hand_is_measured_where_odometry_puts_the_frame(room, session, source_of):
    drift = exp([0.06, -0.03, 0.05, 0.0, 0.02, 0.0])

    loop = loop_seen_from(room, session, source_of, HERE, drift)

    assert loop is not None
    error = inverse(HERE) @ loop.T_earlier_keyframe
    assert np.linalg.norm(error[:3, 3]) < 0.003


def test_a_keyframe_of_another_place_is_no_loop(room, session, source_of):
    assert loop_seen_from(room, session, source_of, BEHIND) is None
