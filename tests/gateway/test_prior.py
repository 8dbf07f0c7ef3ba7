"""What tracking remembers, from answer to answer."""

import dataclasses

import numpy as np
import pytest

from services.gateway.prior import next_prior, resumed_prior
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import (
    ColourEncoding,
    ColourImage,
    DepthEncoding,
    DepthImage,
    Frame,
    TrackingStatus,
)
from shared.se3 import exp
from shared.tracks import FrameRecord, KeyframePoses, OpenReply, TrackResult


def frame(seq, image=None):
    """A frame; its image is that of its own number unless told."""
    rgb = ColourImage(ColourEncoding.JPEG, bytes([seq if image is None else image]))
    return Frame(seq, 100 * seq, rgb, DepthImage(DepthEncoding.RAW16, b""))


def result(seq, T_world_camera, status=TrackingStatus.TRACKED, keyframe=None):
    return TrackResult(
        seq=seq,
        t_ns=100 * seq,
        status=status,
        T_world_camera=T_world_camera,
        covariance=np.eye(6),
        reference_seq=0,
        T_reference_camera=T_world_camera,
        inliers=1,
        inlier_share=1.0,
        map_revision=1,
        keyframe=keyframe,
    )


def after(prior, answer, image=None):
    following = next_prior(prior, frame(answer.seq, image), answer)
    assert following is not None
    return following


@pytest.fixture
def first():
    return after(None, result(0, np.eye(4), keyframe=object()))


def test_the_first_prior_stands_still_at_its_keyframe(first):
    assert (first.seq, first.newest_keyframe_seq, first.frames_since_keyframe) == (0, 0, 0)
    assert first.before_last_dt_ns == 0
    np.testing.assert_array_equal(first.T_before_last, np.eye(4))


def test_the_motion_maps_points_of_the_last_camera_to_the_one_before(first):
    T_world_last = exp([0.1, 0.2, 0.3, 0.1, 0.0, 0.2])
    second = after(first, result(3, T_world_last))

    np.testing.assert_allclose(first.T_world_camera @ second.T_before_last, T_world_last)
    assert (second.before_last_dt_ns, second.frames_since_keyframe) == (300, 1)


def test_a_repeated_image_leaves_time_and_motion_as_when_it_was_new(first):
    T_world_camera = exp([0.1, 0.0, 0.0, 0.0, 0.1, 0.0])
    second = after(first, result(1, T_world_camera))

    repeated = after(second, result(2, T_world_camera), image=1)

    assert (repeated.seq, repeated.frames_since_keyframe) == (2, 2)
    assert (repeated.t_ns, repeated.before_last_dt_ns) == (100, 100)
    np.testing.assert_array_equal(repeated.T_before_last, second.T_before_last)


def test_a_lost_frame_keeps_the_last_pose_and_counts(first):
    lost = after(first, result(4, exp([9, 9, 9, 0, 0, 0]), TrackingStatus.LOST))

    assert (lost.seq, lost.lost_frames, lost.frames_since_keyframe) == (0, 1, 1)
    np.testing.assert_array_equal(lost.T_world_camera, np.eye(4))


def test_a_pose_after_lost_frames_ends_the_count(first):
    lost = after(first, result(4, np.eye(4), TrackingStatus.LOST))

    found = after(lost, result(5, np.eye(4), TrackingStatus.RELOCALISED))

    assert found.lost_frames == 0


def test_a_session_without_a_pose_has_no_prior():
    assert next_prior(None, frame(0), result(0, np.eye(4), TrackingStatus.NEED_FRAMES)) is None


def opened(last, keyframe_seqs):
    poses = np.broadcast_to(np.eye(4), (len(keyframe_seqs), 4, 4)).copy()
    return OpenReply(
        session="s",
        mapper="m",
        epoch=2,
        mode="live",
        map_revision=7,
        created_ns=0,
        calibration=Calibration(Camera(Intrinsics(60, 60, 32, 24, 64, 48)), 1000.0),
        T_world_first=np.eye(4),
        last=last,
        keyframe_poses=KeyframePoses(7, np.array(keyframe_seqs, np.int64), poses),
    )


def test_a_resumed_session_goes_on_from_its_last_record():
    T = exp([1.0, 0, 0, 0, 0, 0])
    record = FrameRecord(25, 2500, TrackingStatus.TRACKED, 20, T, T, np.eye(6))

    prior = resumed_prior(opened(record, [0, 10, 20]))

    assert prior is not None
    assert (prior.seq, prior.t_ns, prior.reference_seq) == (25, 2500, 20)
    assert (prior.newest_keyframe_seq, prior.frames_since_keyframe) == (20, 5)
    np.testing.assert_array_equal(prior.T_world_camera, T)


def test_a_new_session_has_no_prior():
    assert resumed_prior(opened(None, [])) is None


def test_the_motion_is_the_trackers_where_the_map_moved_between_two_answers(first):
    step = exp([0.02, 0.0, 0.01, 0.0, 0.03, 0.0])
    in_the_moved_map = exp([0.5, 0.0, 0.0, 0.0, 0.1, 0.0]) @ step
    answer = dataclasses.replace(result(1, in_the_moved_map), T_last_camera=step)

    second = after(first, answer)

    np.testing.assert_array_equal(second.T_before_last, step)
    np.testing.assert_array_equal(second.T_reference_camera, answer.T_reference_camera)
