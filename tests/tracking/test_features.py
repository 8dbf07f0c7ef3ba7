import dataclasses

import cv2
import numpy as np
import pytest

from services.tracking.config import OrbConfig, RelocalizationConfig
from services.tracking.detection import detect, spread
from services.tracking.matching import (
    match_by_descriptor,
    match_by_projection,
    popcount,
    two_nearest,
)
from services.tracking.orb import extract_features
from services.tracking.relocalization import locate
from shared.rectify import RgbdImage
from shared.se3 import angle_rad, exp, inverse, transform
from shared.tracks import Landmarks

CONFIG = OrbConfig()
AWAY = exp([0.3, 0.1, 0.2, 0.05, -0.25, 0.1])


def landmarks_of(features, intrinsics, T_world_camera=None) -> Landmarks:
    """A landmark for every feature with depth, as its keyframe would found them."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    rows = np.flatnonzero(features.depths_m > 0.0)
    points = features.points_camera(intrinsics)[rows]
    return Landmarks(
        ids=rows.astype(np.int64),
        positions_world=transform(T, points),
        normals_world=np.zeros((len(rows), 3), np.float32),
        descriptors=features.descriptors[rows],
        octaves=features.octaves[rows],
        distances_m=np.linalg.norm(points, axis=1).astype(np.float32),
    )


def test_features_reach_all_over_the_image(room):
    features = extract_features(room.view(np.eye(4)), CONFIG)

    quarters = (features.keypoints_px[:, 0] > 160) * 2 + (features.keypoints_px[:, 1] > 120)
    assert np.bincount(quarters.astype(int), minlength=4).min() > 50


def test_spreading_takes_the_best_of_each_cell_first():
    pixels = np.array([[5, 5], [6, 6], [7, 7], [100, 100]], np.float32)
    responses = np.array([1.0, 3.0, 2.0, 0.5], np.float32)

    chosen = spread(pixels, responses, cell_px=40, limit=3)

    assert chosen.tolist() == [1, 3, 2]


@pytest.mark.parametrize("axis", [0, 1], ids=["up and down", "left and right"])
def test_keypoints_of_a_mirrored_image_are_mirrored_at_every_octave(room, axis):
    rgb = room.view(np.eye(4)).rgb
    size = np.array([rgb.shape[1], rgb.shape[0]])

    found = detect(rgb, CONFIG)
    mirrored = detect(np.ascontiguousarray(np.flip(rgb, axis)), CONFIG)

    back = mirrored.keypoints_px.copy()
    back[:, 1 - axis] = size[1 - axis] - 1 - back[:, 1 - axis]
    for octave in np.flatnonzero(np.bincount(found.octaves) >= 10):
        here = found.keypoints_px[found.octaves == octave]
        there = back[mirrored.octaves == octave]
        apart = np.linalg.norm(here[:, None] - there[None], axis=2).min(axis=1)
        assert np.median(apart) < 0.05


def test_a_mask_keeps_keypoints_of_every_octave_out(room):
    rgb = room.view(np.eye(4)).rgb
    is_left = np.arange(rgb.shape[1])[None, :] < np.full((rgb.shape[0], 1), 160)

    found = detect(rgb, CONFIG, is_left)

    assert found.keypoints_px[:, 0].max() < 161.0
    assert len(np.unique(found.octaves)) > 3


def test_an_image_without_texture_has_no_features(room):
    image = room.view(np.eye(4))
    grey = RgbdImage(np.full_like(image.rgb, 90), image.depth_m, image.intrinsics)

    assert len(extract_features(grey, CONFIG).octaves) == 0


def test_a_tenth_of_the_light_leaves_enough_features(room):
    image = room.view(np.eye(4))
    dark = RgbdImage(image.rgb // 10, image.depth_m, image.intrinsics)

    assert len(extract_features(dark, CONFIG).octaves) >= CONFIG.few_features


def test_depth_at_an_edge_is_not_trusted(room):
    image = room.view(np.eye(4))
    torn = image.depth_m * (1.0 + 0.2 * (np.indices(image.depth_m.shape).sum(axis=0) % 2))

    features = extract_features(RgbdImage(image.rgb, torn, image.intrinsics), CONFIG)

    assert (features.depths_m == 0.0).all()


def test_most_features_keep_their_depth_under_a_noisy_sensor(room):
    image = room.view(np.eye(4))
    noise = np.random.default_rng(0).standard_normal(image.depth_m.shape)
    noisy = (image.depth_m * (1.0 + 0.03 * noise)).astype(np.float32)

    features = extract_features(RgbdImage(image.rgb, noisy, image.intrinsics), CONFIG)

    exact = extract_features(image, CONFIG)
    both = (features.depths_m > 0.0) & (exact.depths_m > 0.0)
    errors = features.depths_m[both] / exact.depths_m[both] - 1.0
    assert both.sum() > 0.5 * (exact.depths_m > 0.0).sum()
    assert np.sqrt(np.mean(errors**2)) < 0.015


def test_population_count_equals_that_of_python():
    words = np.random.default_rng(0).integers(0, 2**63, 100, np.uint64)

    assert [popcount(word) for word in words] == [int(word).bit_count() for word in words]


def test_landmarks_are_found_where_their_own_features_are(room):
    image = room.view(np.eye(4))
    features = extract_features(image, CONFIG)
    landmarks = landmarks_of(features, image.intrinsics)

    matches = match_by_projection(features, landmarks, np.eye(4), image.intrinsics, CONFIG)

    assert len(matches) > 0.8 * len(landmarks.ids)
    assert (matches.features == landmarks.ids[matches.landmarks]).mean() > 0.99


def test_landmarks_seen_from_behind_are_not_matched(room):
    image = room.view(np.eye(4))
    features = extract_features(image, CONFIG)
    landmarks = landmarks_of(features, image.intrinsics)
    behind = dataclasses.replace(
        landmarks, normals_world=np.tile(np.array([0, 0, 1], np.float32), (len(landmarks.ids), 1))
    )

    matches = match_by_projection(features, behind, np.eye(4), image.intrinsics, CONFIG)

    assert len(matches) == 0


def test_no_feature_and_no_landmark_is_matched_twice(room):
    there, here = room.view(np.eye(4)), room.view(AWAY)
    landmarks = landmarks_of(extract_features(there, CONFIG), there.intrinsics)
    features = extract_features(here, CONFIG)

    for matches in (
        match_by_projection(features, landmarks, AWAY, here.intrinsics, CONFIG),
        match_by_descriptor(features, landmarks, CONFIG),
    ):
        assert len(matches) > 20
        assert len(set(matches.features.tolist())) == len(matches)
        assert len(set(matches.landmarks.tolist())) == len(matches)


def test_the_two_nearest_descriptors_are_those_of_opencv():
    rng = np.random.default_rng(7)
    some, others = (
        rng.integers(0, 256, (50, 32), np.uint8),
        rng.integers(0, 256, (333, 32), np.uint8),
    )
    some[:20] = others[100:120]

    nearest, bits, second_bits = two_nearest(some, others)

    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(some, others, k=2)
    np.testing.assert_array_equal(nearest, [a.trainIdx for a, _ in pairs])
    np.testing.assert_array_equal(bits, [a.distance for a, _ in pairs])
    np.testing.assert_array_equal(second_bits, [b.distance for _, b in pairs])


def test_a_camera_is_located_by_features_alone(room):
    there, here = room.view(np.eye(4)), room.view(AWAY)
    landmarks = landmarks_of(extract_features(there, CONFIG), there.intrinsics)
    features = extract_features(here, CONFIG)

    T = locate(features, landmarks, here.intrinsics, CONFIG, RelocalizationConfig())

    assert T is not None
    difference = inverse(AWAY) @ T
    assert np.linalg.norm(difference[:3, 3]) < 0.03
    assert np.degrees(angle_rad(difference)) < 1.0


def test_a_place_never_seen_locates_nobody(room):
    there = room.view(np.eye(4))
    landmarks = landmarks_of(extract_features(there, CONFIG), there.intrinsics)
    noise = np.random.default_rng(3).integers(0, 255, there.rgb.shape).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.uint8)
    features = extract_features(RgbdImage(blurred, there.depth_m, there.intrinsics), CONFIG)

    T = locate(features, landmarks, there.intrinsics, CONFIG, RelocalizationConfig())

    assert T is None


def test_an_empty_map_locates_nobody(room):
    image = room.view(np.eye(4))
    features = extract_features(image, CONFIG)
    landmarks = landmarks_of(features, image.intrinsics)
    none = Landmarks(**{f: getattr(landmarks, f)[:0] for f in landmarks.__dict__})

    T = locate(features, none, image.intrinsics, CONFIG, RelocalizationConfig())

    assert T is None
