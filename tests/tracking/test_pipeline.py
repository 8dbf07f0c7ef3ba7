import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from services.tracking.config import OrbConfig, TrackingConfig, VerificationConfig
from shared.errors import InputError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage, TrackingStatus
from shared.se3 import angle_rad, exp, inverse

STEP = np.array([0.02, -0.005, 0.015, 0.004, 0.012, -0.003])


def path(index: int) -> np.ndarray:
    return exp(index * STEP)


def walk(room, session, count: int):
    """Track the first frames of the path; the last result."""
    return [session.track(room.frame(i, path(i))) for i in range(count)][-1]


def error(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    difference = inverse(T_true) @ T
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(angle_rad(difference)))


def empty_depth(frame):
    nothing = DepthImage(DepthEncoding.RAW16, bytes(len(frame.depth.bytes)))
    return dataclasses.replace(frame, depth=nothing)


def blind(frame):
    black = ColourImage(ColourEncoding.RGB8, bytes(len(frame.rgb.bytes)))
    return dataclasses.replace(empty_depth(frame), rgb=black)


def test_poses_of_a_walk_through_the_room_are_within_two_millimetres(room, session):
    results = [session.track(room.frame(i, path(i))) for i in range(25)]

    errors = [error(r.T_world_camera, path(i)) for i, r in enumerate(results)]
    assert {r.status for r in results} == {TrackingStatus.TRACKED}
    assert max(metres for metres, _ in errors) < 0.002
    assert max(degrees for _, degrees in errors) < 0.1


def test_the_first_frame_founds_the_world(room, session):
    result = session.track(room.frame(3, np.eye(4)))

    assert result.status is TrackingStatus.TRACKED
    assert result.keyframe is not None
    assert result.reference_seq == 3
    np.testing.assert_array_equal(result.T_world_camera, np.eye(4))


def test_a_first_frame_that_may_not_enter_the_map_has_no_answer_yet(room, session):
    frame = dataclasses.replace(room.frame(0, np.eye(4)), may_be_keyframe=False)

    assert session.track(frame).status is TrackingStatus.NEED_FRAMES


def test_a_first_frame_without_depth_has_no_answer_yet(room, session):
    result = session.track(empty_depth(room.frame(0, np.eye(4))))

    assert result.status is TrackingStatus.NEED_FRAMES


def test_a_blind_frame_is_lost_and_repeats_the_pose_before_it(room, session):
    before = walk(room, session, 3)

    result = session.track(blind(room.frame(3, path(3))))

    assert result.status is TrackingStatus.LOST
    np.testing.assert_array_equal(result.T_world_camera, before.T_world_camera)
    assert result.keyframe is None


def test_a_lost_frame_stays_where_it_was_told_beside_its_keyframe(room, session):
    before = walk(room, session, 3)

    result = session.track(blind(room.frame(3, path(3))))
    T_world_camera = session.store.pose(result.reference_seq) @ result.T_reference_camera

    np.testing.assert_allclose(T_world_camera, before.T_world_camera, atol=1e-12)


@pytest.mark.parametrize(
    ("lost_frames", "status"), [(2, TrackingStatus.TRACKED), (6, TrackingStatus.LOST)]
)
def test_after_a_while_a_few_features_nearby_do_not_bring_the_camera_back(
    room, new_session, lost_frames, status
):
    few = TrackingConfig(  # enough to go on, not to be found by
        orb=OrbConfig(num_features=38), verification=VerificationConfig(min_inliers=5)
    )
    session = new_session(config=few)
    walk(room, session, 3)
    for i in range(3, 3 + lost_frames):
        session.track(blind(room.frame(i, path(3))))

    assert session.track(room.frame(3 + lost_frames, path(3))).status is status


def test_tracking_goes_on_after_blind_frames(room, session):
    walk(room, session, 3)
    for i in range(3, 6):
        session.track(blind(room.frame(i, path(i))))

    result = session.track(room.frame(6, path(6)))

    assert result.status in (TrackingStatus.TRACKED, TrackingStatus.RELOCALISED)
    assert error(result.T_world_camera, path(6))[0] < 0.002


def test_a_kidnapped_camera_finds_itself_in_the_map(room, session):
    away = exp([0.2, 0.0, -0.3, 0.0, 1.6, 0.0])
    walk(room, session, 3)
    session.prior = dataclasses.replace(session.prior, T_world_camera=away, lost_frames=5)

    result = session.track(room.frame(3, path(4)))

    assert result.status in (TrackingStatus.TRACKED, TrackingStatus.RELOCALISED)
    assert error(result.T_world_camera, path(4))[0] < 0.005


def test_a_large_step_is_found_by_its_features(room, session):
    far = exp([0.25, 0.05, -0.2, 0.05, 0.3, 0.02])
    session.track(room.frame(0, np.eye(4)))

    result = session.track(room.frame(1, far))

    assert result.status is TrackingStatus.TRACKED
    assert error(result.T_world_camera, far)[0] < 0.003


def test_the_pose_is_told_relative_to_its_reference(room, session):
    result = walk(room, session, 8)

    told = session.store.pose(result.reference_seq) @ result.T_reference_camera
    np.testing.assert_allclose(told, result.T_world_camera, atol=1e-12)


def test_the_covariance_is_that_of_a_pose_known_to_millimetres(room, session):
    result = walk(room, session, 3)

    np.testing.assert_allclose(result.covariance, result.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(result.covariance).min() > 0.0
    assert np.sqrt(np.diag(result.covariance)[:3]).max() < 0.005


def test_the_same_request_gives_the_same_bits(room, session):
    walk(room, session, 4)
    frame = room.frame(14, path(12))

    first, second = session.answer(frame), session.answer(frame)

    np.testing.assert_array_equal(first.T_world_camera, second.T_world_camera)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert first.keyframe is not None and second.keyframe is not None
    np.testing.assert_array_equal(
        first.keyframe.correction.positions_world, second.keyframe.correction.positions_world
    )


def test_a_helping_thread_changes_no_bit(room, session):
    walk(room, session, 4)
    frame = room.frame(14, path(12))

    alone = session.answer(frame)
    with ThreadPoolExecutor(1) as helper:
        helped = session.answer(frame, helper)

    np.testing.assert_array_equal(alone.T_world_camera, helped.T_world_camera)
    np.testing.assert_array_equal(alone.covariance, helped.covariance)
    assert alone.keyframe is not None and helped.keyframe is not None
    np.testing.assert_array_equal(
        alone.keyframe.observations.descriptors, helped.keyframe.observations.descriptors
    )


def test_every_stage_is_timed(room, session):
    result = walk(room, session, 2)

    stages = {"decode_colour", "decode_depth", "points", "orb", "context", "coarse", "refine"}
    assert stages | {"keyframe", "total"} <= set(result.timings_ms)


def test_a_truncated_depth_image_is_refused_by_name(room, session):
    frame = room.frame(0, np.eye(4))
    cut = DepthImage(DepthEncoding.RAW16, frame.depth.bytes[:-10])

    with pytest.raises(InputError, match="depth.bytes"):
        session.track(dataclasses.replace(frame, depth=cut))


CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])  # two walls and the floor hold all six directions


def dark(frame):
    black = ColourImage(ColourEncoding.RGB8, bytes(len(frame.rgb.bytes)))
    return dataclasses.replace(frame, rgb=black)


def test_in_the_dark_geometry_holds_the_pose_and_says_so(room, session):
    session.track(room.frame(0, CORNER))

    result = session.track(dark(room.frame(1, CORNER @ path(1))))

    assert result.status is TrackingStatus.COARSE_ONLY
    assert error(result.T_world_camera, path(1))[0] < 0.002


def test_in_the_dark_a_leap_is_not_believed(room, session):
    session.track(room.frame(0, CORNER))

    result = session.track(dark(room.frame(1, CORNER @ exp([0.0, 0.0, 0.0, 0.0, 1.6, 0.0]))))

    assert result.status is TrackingStatus.LOST
