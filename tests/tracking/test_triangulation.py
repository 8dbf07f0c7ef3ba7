"""Landmarks from two views, of features that have no depth."""

import dataclasses

import numpy as np
import pytest

from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import TriangulationConfig
from services.tracking.keyframes import keyframe_observations
from services.tracking.orb import extract_features
from services.tracking.triangulation import triangulate
from shared.camera import Intrinsics
from shared.errors import ConfigError
from shared.frames import DepthEncoding, DepthImage, Frame, TrackingStatus
from shared.rectify import RgbdImage
from shared.se3 import exp, inverse, transform
from shared.tracks import NO_LANDMARK, Observations, TrackResult, WindowKeyframe, landmark_id

HALF_SIDES_M = np.array([1.6, 1.2, 2.1])  # of the room
CAMERA = Intrinsics(500.0, 510.0, 320.0, 240.0, 640, 480)
CONFIG = TriangulationConfig()
COUNT = 60
ASIDE = exp([0.3, 0.02, -0.05, 0.02, -0.05, 0.01])


def scene(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1.2, -0.8, 3.0], [1.2, 0.8, 6.0], (COUNT, 3))


def keyframe(seq: int, T: np.ndarray, points: np.ndarray, depths_m=0.0) -> WindowKeyframe:
    """What a camera sees of some points; each looks the same from everywhere."""
    own = transform(inverse(T), points)
    pixels = own[:, :2] / own[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    looks = np.random.default_rng(9).integers(0, 256, (len(points), 32)).astype(np.uint8)
    seen = Observations(
        landmark_ids=landmark_id(seq, np.arange(len(points))),
        keypoints_px=pixels.astype(np.float32),
        octaves=np.zeros(len(points), np.uint8),
        depths_m=np.full(len(points), depths_m, np.float32),
        descriptors=looks,
    )
    return WindowKeyframe(seq, T, is_fixed=False, observations=seen)


def changed(keyframe: WindowKeyframe, **changes) -> WindowKeyframe:
    observations = dataclasses.replace(keyframe.observations, **changes)
    return dataclasses.replace(keyframe, observations=observations)


def test_points_lie_where_two_views_see_them():
    points = scene()

    placed = triangulate(
        keyframe(5, ASIDE, points), (keyframe(2, np.eye(4), points),), CAMERA, CONFIG
    )

    np.testing.assert_array_equal(np.sort(placed.features), np.arange(COUNT))
    np.testing.assert_allclose(placed.positions_world, points[placed.features], atol=1e-3)


def test_they_are_the_landmarks_of_the_view_that_saw_them_first():
    points = scene()
    new = keyframe(5, ASIDE, points)

    placed = triangulate(new, (keyframe(2, np.eye(4), points),), CAMERA, CONFIG)

    np.testing.assert_array_equal(placed.landmark_ids, landmark_id(2, placed.features))
    np.testing.assert_array_equal(
        placed.named(new.observations).landmark_ids, landmark_id(2, np.arange(COUNT))
    )


def test_a_camera_that_only_turns_places_nothing():
    points, turned = scene(), exp([0.0, 0.0, 0.0, 0.02, 0.1, 0.0])

    placed = triangulate(
        keyframe(5, turned, points), (keyframe(2, np.eye(4), points),), CAMERA, CONFIG
    )

    assert len(placed.features) == 0


def test_rays_that_part_place_nothing():
    points = scene()
    aside = exp([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    apart = dataclasses.replace(keyframe(5, aside, points), T_world_camera=inverse(aside))

    placed = triangulate(apart, (keyframe(2, np.eye(4), points),), CAMERA, CONFIG)

    assert len(placed.features) == 0


def test_what_lies_off_the_epipolar_line_is_something_else():
    points = scene()
    new = keyframe(5, exp([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]), points)  # its lines are rows
    pixels = new.observations.keypoints_px + np.array([0.0, 4.0], np.float32)

    moved = changed(new, keypoints_px=pixels)
    placed = triangulate(moved, (keyframe(2, np.eye(4), points),), CAMERA, CONFIG)

    assert len(placed.features) == 0


def test_a_patch_of_another_size_is_something_else():
    points = scene()
    new = changed(keyframe(5, ASIDE, points), octaves=np.full(COUNT, 3, np.uint8))

    placed = triangulate(new, (keyframe(2, np.eye(4), points),), CAMERA, CONFIG)

    assert len(placed.features) == 0


def test_what_has_two_of_a_kind_on_its_line_is_not_placed():
    points = np.array([[-0.5, 0.0, 4.0], [0.5, 0.0, 4.0]])  # the first could be the second, nearer
    aside = exp([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    same = np.zeros((2, 32), np.uint8)
    first = changed(keyframe(2, np.eye(4), points), descriptors=same)

    placed = triangulate(
        changed(keyframe(5, aside, points), descriptors=same), (first,), CAMERA, CONFIG
    )

    assert landmark_id(2, np.array([1]))[0] not in placed.landmark_ids


def test_a_feature_places_the_landmark_of_one_view_only():
    points = scene()
    window = (keyframe(1, np.eye(4), points), keyframe(2, exp([0.02, 0, 0, 0, 0, 0]), points))

    placed = triangulate(keyframe(5, ASIDE, points), window, CAMERA, CONFIG)

    assert len(np.unique(placed.features)) == len(placed.features) == COUNT


@pytest.mark.parametrize("depths_m", [(4.0, 0.0), (0.0, 4.0)])
def test_what_has_depth_waits_for_nobody(depths_m):
    points = scene()
    first = keyframe(2, np.eye(4), points, depths_m[0])

    placed = triangulate(keyframe(5, ASIDE, points, depths_m[1]), (first,), CAMERA, CONFIG)

    assert len(placed.features) == 0


def test_without_anything_in_common_nothing_is_placed():
    none = keyframe(5, ASIDE, scene()[:0])

    placed = triangulate(none, (keyframe(2, np.eye(4), scene()),), CAMERA, CONFIG)

    assert len(placed.features) == len(placed.landmark_ids) == len(placed.positions_world) == 0


def test_limits_must_be_positive():
    with pytest.raises(ConfigError, match="min_parallax_deg must be positive, got 0"):
        TriangulationConfig(min_parallax_deg=0.0)


def with_depth_left_of(column: int, frame: Frame) -> Frame:
    """As a sensor would send it that sees only a part of what the camera does."""
    raw = np.frombuffer(frame.depth.bytes, "<u2").reshape(240, 320).copy()
    raw[:, column:] = 0
    return dataclasses.replace(frame, depth=DepthImage(DepthEncoding.RAW16, raw.tobytes()))


def test_features_wait_where_nothing_is_measured_but_not_at_edges(room, session):
    image = room.view(np.eye(4))
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    torn = np.where((u + v) % 2 == 0, image.depth_m, 0.5 * image.depth_m)
    depth_m = np.select([u < 100, u < 200], [image.depth_m, torn], 0.0).astype(np.float32)
    features = extract_features(RgbdImage(image.rgb, depth_m, image.intrinsics), session.config.orb)

    none = np.full(len(features.octaves), NO_LANDMARK, np.int64)
    seen = keyframe_observations(3, features, none)

    column = features.keypoints_px[:, 0]
    is_torn, is_dark = (column > 102) & (column < 197), column > 202
    assert (seen.landmark_ids[is_torn] == NO_LANDMARK).all()
    np.testing.assert_array_equal(
        seen.landmark_ids[is_dark], landmark_id(3, np.flatnonzero(is_dark))
    )


def errors_m(results: list[TrackResult], truth: list[np.ndarray]) -> np.ndarray:
    return np.array(
        [
            np.linalg.norm((inverse(T) @ result.T_world_camera)[:3, 3])
            for T, result in zip(truth, results, strict=True)
        ]
    )


def test_landmarks_are_placed_beside_the_part_of_an_image_that_has_depth(room, session):
    truth = [exp([0.02 * i, 0.0, 0.0, 0.0, 0.0, 0.0]) for i in range(12)]

    for i, T in enumerate(truth):
        session.track(with_depth_left_of(160, room.frame(i, T)))

    landmarks = session.store.context(-1).landmarks.positions_world
    off = HALF_SIDES_M - np.abs(landmarks)  # of the nearest wall
    aside = landmarks[:, 0] > truth[-1][0, 3] + 0.1  # never in the half that has depth
    assert aside.sum() > 50
    assert np.median(np.abs(off[aside]).min(axis=1)) < 0.05  # in 320 pixels from 20 cm


def test_a_camera_goes_on_where_its_depth_ends(room, session):
    truth = [exp([0.03 * i, 0.0, 0.0, 0.0, 0.0, 0.0]) for i in range(26)]
    columns = [320 if i < 6 else 0 for i in range(26)]
    frames = [room.frame(i, T) for i, T in enumerate(truth)]

    results = [
        session.track(with_depth_left_of(column, frame))
        for column, frame in zip(columns, frames, strict=True)
    ]

    assert {result.status for result in results[6:]} == {TrackingStatus.COARSE_ONLY}
    assert any(result.keyframe is not None for result in results[6:])
    assert errors_m(results, truth).max() < 0.04


def test_a_wrong_observation_of_a_landmark_is_named_by_the_next_keyframe(room, session):
    truth = [exp([0.03 * i, 0.0, 0.0, 0.0, 0.0, 0.0]) for i in range(30)]
    results = iter(session.track(room.frame(i, T)) for i, T in enumerate(truth))
    [next(r for r in results if r.keyframe is not None) for _ in range(2)]
    second = session.store.context(-1).window[-1]
    wrong = second.observations.landmark_ids[0]
    shift_feature(session.store, second.seq, wrong)

    correction = next(r for r in results if r.keyframe is not None).keyframe.correction

    assert (second.seq, wrong) in [tuple(row) for row in correction.outliers.tolist()]


def shift_feature(store: KeyframeStore, seq: int, landmark: int) -> None:
    """As if a keyframe had taken something else for a landmark."""
    keyframe = store._keyframes[seq]
    pixels = keyframe.observations.keypoints_px.copy()
    pixels[keyframe.observations.landmark_ids == landmark] += 40.0
    moved = dataclasses.replace(keyframe.observations, keypoints_px=pixels)
    store._keyframes[seq] = dataclasses.replace(keyframe, observations=moved)
