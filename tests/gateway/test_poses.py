"""The ring of last poses: by time, and in the map as it is now."""

import numpy as np
import pytest

from services.gateway.poses import PoseRing, deviations
from shared.errors import NotFoundError
from shared.frames import TrackingStatus
from shared.se3 import exp, log
from shared.tracks import FrameRecord, KeyframePoses

SECOND = 1_000_000_000
NO_CORRECTION = KeyframePoses(0, np.zeros(0, np.int64), np.zeros((0, 4, 4)))


def record(seq, twist, status=TrackingStatus.TRACKED):
    T = exp(twist)
    return FrameRecord(seq, seq * SECOND, status, 0, T, T, 1e-4 * np.eye(6))


@pytest.fixture
def ring():
    ring = PoseRing(size=10, max_gap_s=2.0)
    for seq in range(5):
        ring.add(record(seq, [0.1 * seq, 0, 0, 0, 0, 0.2 * seq]), map_revision=3)
    return ring


def test_halfway_in_time_is_halfway_in_the_motion(ring):
    pose = ring.at(SECOND // 2, NO_CORRECTION)

    np.testing.assert_allclose(log(pose.T_map_camera), [0.05, 0, 0, 0, 0, 0.1], atol=1e-12)
    assert pose.is_interpolated


def test_at_a_frames_own_time_the_pose_is_the_frames(ring):
    pose = ring.at(2 * SECOND, NO_CORRECTION)

    assert (pose.seq, pose.is_interpolated) == (2, False)


@pytest.mark.parametrize("t_ns", [-1, 4 * SECOND + 1])
def test_beyond_the_ends_there_is_no_pose(ring, t_ns):
    with pytest.raises(NotFoundError):
        ring.at(t_ns, NO_CORRECTION)


def test_across_a_gap_there_is_no_pose(ring):
    ring.add(record(9, np.zeros(6)), map_revision=3)

    with pytest.raises(NotFoundError, match="none from"):
        ring.at(6 * SECOND, NO_CORRECTION)


def test_lost_frames_are_not_interpolated_from(ring):
    ring.add(record(5, [9, 9, 9, 0, 0, 0], TrackingStatus.LOST), map_revision=3)

    with pytest.raises(NotFoundError):
        ring.at(4 * SECOND + 5, NO_CORRECTION)


def test_only_a_tracked_pose_has_a_deviation(ring):
    tracked = ring.last(NO_CORRECTION).deviations()
    ring.add(record(5, [9, 9, 9, 0, 0, 0], TrackingStatus.LOST), map_revision=3)

    assert tracked is not None
    assert ring.last(NO_CORRECTION).deviations() is None


def test_the_oldest_pose_makes_room(ring):
    for seq in range(5, 15):
        ring.add(record(seq, np.zeros(6)), map_revision=3)

    with pytest.raises(NotFoundError):
        ring.at(4 * SECOND, NO_CORRECTION)


def test_a_pose_moves_with_its_keyframe_when_the_map_is_corrected(ring):
    moved = exp([0, 1, 0, 0, 0, 0])
    corrected = KeyframePoses(4, np.array([0], np.int64), moved[None])

    before, after = ring.last(NO_CORRECTION), ring.last(corrected)

    np.testing.assert_allclose(after.T_map_camera, moved @ before.T_map_camera)
    assert (before.map_revision, after.map_revision) == (3, 4)


def test_a_correction_that_the_pose_knew_already_does_not_move_it(ring):
    known = KeyframePoses(3, np.array([0], np.int64), exp([0, 1, 0, 0, 0, 0])[None])

    np.testing.assert_array_equal(
        ring.last(known).T_map_camera, ring.last(NO_CORRECTION).T_map_camera
    )


def test_deviations_are_those_of_position_and_rotation():
    covariance = np.diag([1e-4, 4e-4, 4e-4, 1e-6, 1e-6, 2e-6])

    assert deviations(covariance) == pytest.approx((0.03, np.degrees(0.002)))


def test_an_unknown_covariance_has_no_deviation():
    assert deviations(np.full((6, 6), np.inf)) is None


def test_the_oldest_frames_leave_when_the_ring_is_full(ring):
    for seq in range(5, 25):
        ring.add(record(seq, [0.1 * seq, 0, 0, 0, 0, 0]), map_revision=3)

    assert ring.at(15 * SECOND, NO_CORRECTION).seq == 15
    assert ring.last(NO_CORRECTION).seq == 24
    with pytest.raises(NotFoundError, match="kept from 15000000000 to 24000000000"):
        ring.at(14 * SECOND, NO_CORRECTION)
