"""Input that no algorithm can love: a documented status, no wrong pose believed, a safe map."""

import dataclasses

import numpy as np
import pytest

from shared.frames import (
    HAS_POSE,
    ColourEncoding,
    ColourImage,
    DepthEncoding,
    DepthImage,
    Frame,
    TrackingStatus,
)
from shared.se3 import angle_rad, exp, inverse

TRACKED, COARSE_ONLY, LOST = (
    TrackingStatus.TRACKED,
    TrackingStatus.COARSE_ONLY,
    TrackingStatus.LOST,
)
CORNER = exp([0.0, 0.0, 0.0, 0.4, 0.8, 0.0])  # two walls and the floor hold all six directions
WALL = np.eye(4)
STEP = np.array([0.015, -0.005, 0.01, 0.004, 0.008, -0.003])
NO_READING = 65535


def pixels(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.rgb.bytes, np.uint8).reshape(240, 320, 3).copy()


def depths(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.depth.bytes, "<u2").reshape(240, 320).copy()


def with_pixels(frame: Frame, rgb: np.ndarray) -> Frame:
    image = ColourImage(ColourEncoding.RGB8, np.ascontiguousarray(rgb, np.uint8).tobytes())
    return dataclasses.replace(frame, rgb=image)


def with_depths(frame: Frame, raw: np.ndarray) -> Frame:
    image = DepthImage(DepthEncoding.RAW16, np.ascontiguousarray(raw, "<u2").tobytes())
    return dataclasses.replace(frame, depth=image)


def even(value: int):
    return lambda frame: with_pixels(frame, np.full((240, 320, 3), value))


def saturated(frame: Frame) -> Frame:
    return with_pixels(frame, np.minimum(pixels(frame).astype(np.int64) * 20, 255))


def no_depth(frame: Frame) -> Frame:
    return with_depths(frame, np.zeros((240, 320)))


def no_reading(frame: Frame) -> Frame:
    return with_depths(frame, np.full((240, 320), NO_READING))


def one_depth(frame: Frame) -> Frame:
    raw = np.zeros((240, 320))
    raw[120, 160] = depths(frame)[120, 160]
    return with_depths(frame, raw)


def far_spikes(frame: Frame) -> Frame:
    raw = depths(frame)
    raw[np.random.default_rng(0).random(raw.shape) < 0.1] = 60000
    return with_depths(frame, raw)


def noise(frame: Frame) -> Frame:
    rng = np.random.default_rng(1)
    frame = with_pixels(frame, rng.integers(0, 255, (240, 320, 3)))
    return with_depths(frame, rng.integers(500, 60000, (240, 320)))


def false_wall(frame: Frame) -> Frame:
    """Depth of a wall at two metres everywhere, under the true colours."""
    return with_depths(frame, np.full((240, 320), 10000))


def is_near(T: np.ndarray, T_true: np.ndarray, metres: float, degrees: float) -> bool:
    off = inverse(T_true) @ T
    is_turned = np.degrees(angle_rad(off)) > degrees
    return bool(np.linalg.norm(off[:3, 3]) <= metres and not is_turned)


def walked(room, session, start: np.ndarray, count: int = 4) -> np.ndarray:
    """Track a few good frames from a pose; the world is the first camera's. Where the next is."""
    for i in range(count):
        session.track(room.frame(i, start @ exp(i * STEP)))
    return exp(count * STEP)


@pytest.mark.parametrize(
    ("damage", "start", "expected"),
    [
        (no_depth, CORNER, {COARSE_ONLY}),
        (no_reading, CORNER, {COARSE_ONLY}),
        (one_depth, CORNER, {COARSE_ONLY}),
        (far_spikes, CORNER, {TRACKED}),
        (even(0), CORNER, {COARSE_ONLY}),
        (even(255), CORNER, {COARSE_ONLY}),
        (even(0), WALL, {COARSE_ONLY, LOST}),
        (saturated, CORNER, {TRACKED, COARSE_ONLY}),
        (lambda frame: even(0)(no_depth(frame)), CORNER, {LOST}),
        (lambda frame: even(90)(one_depth(frame)), CORNER, {LOST}),
        (lambda frame: even(90)(false_wall(frame)), CORNER, {LOST}),
        (noise, CORNER, {LOST}),
    ],
)
def test_a_damaged_frame_has_the_status_that_its_evidence_allows(
    room, session, damage, start, expected
):
    T_true = walked(room, session, start)

    result = session.track(damage(room.frame(4, start @ T_true)))

    assert result.status in expected
    if result.status in HAS_POSE and start is CORNER:
        assert is_near(result.T_world_camera, T_true, 0.01, 0.5)


@pytest.mark.parametrize("damage", [no_depth, one_depth, noise, even(0)])
def test_ten_damaged_frames_bring_no_keyframe_that_would_harm_the_map(room, session, damage):
    walked(room, session, WALL)
    before = len(session.store)

    for i in range(4, 14):
        session.track(damage(room.frame(i, WALL @ exp(i * STEP))))
    results = [session.track(room.frame(i, WALL @ exp(i * STEP))) for i in range(14, 18)]

    assert len(session.store) <= before + 1
    assert results[-1].status in HAS_POSE
    assert is_near(results[-1].T_world_camera, exp(17 * STEP), 0.01, 0.5)


def test_true_colours_with_the_depth_of_a_false_wall_are_not_believed(room, session):
    T_true = walked(room, session, CORNER)

    result = session.track(false_wall(room.frame(4, CORNER @ T_true)))

    assert result.status is LOST or is_near(result.T_world_camera, T_true, 0.05, 3.0)
    assert result.keyframe is None


@pytest.mark.parametrize("damage", [no_depth, no_reading, one_depth])
def test_a_map_does_not_begin_without_depth(room, session, damage):
    result = session.track(damage(room.frame(0, np.eye(4))))

    assert result.status is TrackingStatus.NEED_FRAMES
    assert result.keyframe is None


@pytest.mark.parametrize("value", [0, 90, 255])
def test_a_map_of_a_corner_without_texture_is_tracked_by_geometry(room, session, value):
    blank = even(value)
    session.track(blank(room.frame(0, CORNER)))

    results = [session.track(blank(room.frame(i, CORNER @ exp(i * STEP)))) for i in range(1, 8)]

    assert {result.status for result in results} == {COARSE_ONLY}
    for i, result in enumerate(results, 1):
        assert is_near(result.T_world_camera, exp(i * STEP), 0.01, 0.5)


def test_along_a_blank_wall_the_covariance_owns_up_to_the_open_directions(room, session):
    blank = even(90)
    for i in range(3):
        session.track(blank(room.frame(i, WALL)))
    sliding = exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])

    result = session.track(blank(room.frame(3, WALL @ sliding)))

    deviations = np.sqrt(np.diag(result.covariance)[:3])
    assert result.status in (COARSE_ONLY, LOST)
    assert result.status is LOST or deviations[0] > 0.1 > 10 * deviations[2]
    assert result.keyframe is None


def test_a_textured_wall_alone_is_tracked_in_all_six_directions(room, session):
    session.track(room.frame(0, WALL))

    results = [session.track(room.frame(i, WALL @ exp(i * STEP))) for i in range(1, 10)]

    assert {result.status for result in results} == {TRACKED}
    assert is_near(results[-1].T_world_camera, exp(9 * STEP), 0.005, 0.2)


def test_the_same_image_again_is_no_keyframe_however_long(room, session):
    walked(room, session, CORNER, 5)
    before = session.store.seqs()
    frame = room.frame(5, CORNER @ exp([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]))
    first = session.track(dataclasses.replace(frame, may_be_keyframe=False))

    again = [
        session.track(dataclasses.replace(frame, seq=i, t_ns=i * 33_000_000)) for i in range(6, 26)
    ]

    assert first.status in HAS_POSE
    assert all(result.keyframe is None for result in again)
    assert session.store.seqs() == before
