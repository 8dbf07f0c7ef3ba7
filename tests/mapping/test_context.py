import dataclasses
import time

import numpy as np
import pytest

from services.mapping.keyframes.context import ContextConfig
from services.mapping.keyframes.store import KeyframeConfig, KeyframeStore
from services.mapping.keyframes.voxel_merge import merge_clouds
from shared.errors import ConfigError
from shared.se3 import exp, inverse, transform
from shared.tracks import (
    KEYPOINT_BITS,
    MOVING,
    Correction,
    KeyframeData,
    Observations,
    PointCloud,
    landmark_id,
)

STEP_M = 0.1
WALL_M = 2.01
VISIBLE = 200  # landmarks in a row along the wall, one a centimetre


def pose(index: int) -> np.ndarray:
    return exp([index * STEP_M, 0.0, 0.0, 0.0, 0.0, 0.0])


def wall_cloud(count: int = 4000, noise_m: float = 0.0, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.0, -0.8, WALL_M], [1.0, 0.8, WALL_M], (count, 3))
    points[:, 2] += rng.normal(0.0, noise_m, count)
    return PointCloud(
        points.astype(np.float32), np.tile(np.array([0, 0, -1], np.float32), (count, 1))
    )


def keyframe(index: int, noise_m: float = 0.0) -> KeyframeData:
    """Keyframe 10 * index at x = 0.1 * index, which sees landmarks 10 * index and 199 more.

    Landmark j is j centimetres along the wall and was founded by the first keyframe to see it.
    """
    along = np.arange(10 * index, 10 * index + VISIBLE)
    founder = np.maximum(0, -(-(along - VISIBLE + 1) // 10))
    ids = (10 * founder).astype(np.int64) << KEYPOINT_BITS | along
    positions = np.zeros((VISIBLE, 3))
    positions[:, 0] = along * 0.01 - 1.0
    positions[:, 2] = WALL_M
    own = transform(inverse(pose(index)), positions)
    rng = np.random.default_rng(index)
    return KeyframeData(
        observations=Observations(
            landmark_ids=ids,
            keypoints_px=(500 * own[:, :2] / own[:, 2:] + 320).astype(np.float32),
            octaves=np.full(VISIBLE, index % 8, np.uint8),
            depths_m=own[:, 2].astype(np.float32),
            descriptors=rng.integers(0, 256, (VISIBLE, 32)).astype(np.uint8),
        ),
        landmark_normals_camera=np.tile(np.array([0, 0, -1], np.float32), (VISIBLE, 1)),
        cloud_camera=wall_cloud(noise_m=noise_m, seed=index),
        thumbnail=np.zeros((15, 20), np.uint8),
        correction=Correction(np.array([10 * index], np.int64), pose(index)[None], ids, positions),
    )


def walk(count: int, config: ContextConfig | None = None, noise_m: float = 0.0) -> KeyframeStore:
    store = KeyframeStore(KeyframeConfig(context=config or ContextConfig()))
    for index in range(count):
        store.insert(10 * index, index, pose(index), keyframe(index, noise_m))
    return store


def test_an_empty_map_has_an_empty_context():
    context = KeyframeStore().context(-1)

    assert context.num_keyframes == 0
    assert len(context.cloud_world.points) == len(context.landmarks.ids) == 0


def test_the_newest_keyframe_is_the_reference_where_none_is_named():
    store = walk(3)

    assert store.context(-1).reference_seq == 20
    assert store.context(999).reference_seq == 20
    assert store.context(10).reference_seq == 10


def test_the_cloud_lies_on_the_wall_and_faces_the_camera():
    cloud = walk(4).context(-1).cloud_world

    np.testing.assert_allclose(cloud.points[:, 2], WALL_M, atol=1e-5)
    np.testing.assert_allclose(cloud.normals, np.tile([0, 0, -1], (len(cloud.points), 1)))


def test_keyframes_together_are_less_noisy_than_one():
    one, many = (walk(n, noise_m=0.002).context(0).cloud_world.points[:, 2] for n in (1, 8))

    assert np.abs(many - WALL_M).mean() < 0.7 * np.abs(one - WALL_M).mean()


def test_only_keyframes_that_see_the_same_place_take_part():
    store = walk(40)  # 4 m of wall, 2 m in view

    cloud = store.context(0).cloud_world

    assert cloud.points[:, 0].max() < 3.0
    assert {k.seq for k in store.context(0).window} <= set(range(0, 200, 10))


def test_a_keyframe_behind_the_wall_takes_no_part():
    store = walk(1)
    behind = pose(0) @ exp([0.0, 0.0, 4.0, 0.0, np.pi, 0.0])
    store.insert(10, 0, behind, keyframe(0))

    cloud = store.context(0).cloud_world

    assert (cloud.normals[:, 2] < 0.0).all()


def test_sizes_are_bounded():
    config = ContextConfig(max_points=500, max_landmarks=50, max_keyframes=5)

    context = walk(12, config).context(-1)

    assert len(context.cloud_world.points) <= 500
    assert len(context.landmarks.ids) <= 50
    assert len(context.window) <= 5


def test_landmarks_are_in_order_and_where_they_are():
    landmarks = walk(4).context(-1).landmarks

    along = landmarks.ids & ((1 << KEYPOINT_BITS) - 1)
    assert (np.diff(landmarks.ids) > 0).all()
    np.testing.assert_allclose(landmarks.positions_world[:, 0], along * 0.01 - 1.0, atol=1e-12)


def test_a_landmark_looks_as_the_reference_saw_it():
    store = walk(4)
    seen = keyframe(2).observations

    landmarks = store.context(20).landmarks

    at = np.searchsorted(landmarks.ids, seen.landmark_ids)
    np.testing.assert_array_equal(landmarks.descriptors[at], seen.descriptors)
    assert (landmarks.octaves[at] == 2).all()


def test_landmarks_seen_once_long_ago_are_left_out():
    lone = landmark_id(0, np.arange(VISIBLE))

    landmarks = walk(6).context(50).landmarks

    assert landmarks.ids.min() > lone[0]  # the first ten centimetres were seen by keyframe 0 only


def test_the_window_holds_the_reference_and_something_fixed():
    window = walk(20).context(-1).window

    assert window[-1].seq == 190 and not window[-1].is_fixed
    assert sum(k.is_fixed for k in window) >= 1
    assert [k.seq for k in window] == sorted(k.seq for k in window)


def test_the_first_keyframe_is_always_fixed():
    window = walk(3).context(-1).window

    assert [k.is_fixed for k in window] == [True, False, False]


def test_windows_observe_only_landmarks_of_the_context():
    context = walk(8, ContextConfig(max_landmarks=60)).context(-1)

    seen = np.concatenate([k.observations.landmark_ids for k in context.window])
    assert set(seen.tolist()) <= set(context.landmarks.ids.tolist())


def board_in_one_keyframe(moving: bool) -> KeyframeStore:
    """The first of two keyframes has a board before the wall, the second sees through it."""
    store = KeyframeStore()
    first, second = keyframe(0), keyframe(1)
    board = np.random.default_rng(5).uniform([-0.2, -0.2, 1.0], [0.2, 0.2, 1.0], (500, 3))
    wall = first.cloud_camera
    cloud = PointCloud(
        np.concatenate([wall.points, board.astype(np.float32)]),
        np.concatenate([wall.normals, np.tile(np.array([0, 0, -1], np.float32), (500, 1))]),
    )
    store.insert(0, 0, pose(0), dataclasses.replace(first, cloud_camera=cloud))
    if moving:
        ids = second.observations.landmark_ids.copy()
        ids[:20] = MOVING
        seen = dataclasses.replace(second.observations, landmark_ids=ids)
        second = dataclasses.replace(second, observations=seen)
    store.insert(10, 1, pose(1), second)
    return store


def test_where_something_moves_what_the_reference_sees_through_is_left_out():
    points = board_in_one_keyframe(moving=True).context(10).cloud_world.points

    assert (points[:, 2] > WALL_M - 0.1).all()


def test_where_nothing_moves_what_one_keyframe_missed_stays():
    points = board_in_one_keyframe(moving=False).context(10).cloud_world.points

    assert (points[:, 2] < 1.1).sum() > 100


def test_windows_observe_what_moves_too():
    window = board_in_one_keyframe(moving=True).context(10).window

    assert (window[-1].observations.landmark_ids == MOVING).sum() == 20
    assert (window[0].observations.landmark_ids == MOVING).sum() == 0


def waiting(store: KeyframeStore, seq: int) -> np.ndarray:
    """Ids in a keyframe's part of the newest window that no landmark of the context has."""
    context = store.context(-1)
    seen = next(k.observations for k in context.window if k.seq == seq)
    return seen.landmark_ids[~np.isin(seen.landmark_ids, context.landmarks.ids)]


def without_depth(data: KeyframeData, seq: int, count: int) -> KeyframeData:
    """A keyframe whose last features have no depth, so that their landmarks are nowhere yet."""
    seen, correction = data.observations, data.correction
    ids, depths_m = seen.landmark_ids.copy(), seen.depths_m.copy()
    ids[-count:], depths_m[-count:] = landmark_id(seq, np.arange(900, 900 + count)), 0.0
    return dataclasses.replace(
        data,
        observations=dataclasses.replace(seen, landmark_ids=ids, depths_m=depths_m),
        correction=dataclasses.replace(
            correction,
            landmark_ids=correction.landmark_ids[:-count],
            positions_world=correction.positions_world[:-count],
        ),
    )


def walk_without_depth(config: ContextConfig | None = None) -> KeyframeStore:
    store = KeyframeStore(KeyframeConfig(context=config or ContextConfig()))
    for index in range(4):
        data = without_depth(keyframe(index), 10 * index, 20)
        store.insert(10 * index, index, pose(index), data)
    return store


def test_windows_observe_what_has_no_place_yet():
    np.testing.assert_array_equal(
        waiting(walk_without_depth(), 10), landmark_id(10, np.arange(900, 920))
    )


def test_only_the_newest_of_a_window_have_it():
    store = walk_without_depth(ContextConfig(max_waiting_keyframes=2))

    assert [len(waiting(store, seq)) for seq in (0, 10, 20, 30)] == [0, 0, 20, 20]


def test_it_is_a_landmark_once_a_keyframe_places_it():
    store = walk_without_depth()
    placed = landmark_id(10, np.arange(900, 910))
    last = keyframe(4)
    correction = last.correction
    last = dataclasses.replace(
        last,
        correction=dataclasses.replace(
            correction,
            landmark_ids=np.concatenate([correction.landmark_ids, placed]),
            positions_world=np.concatenate([correction.positions_world, np.ones((10, 3))]),
        ),
        observations=dataclasses.replace(
            last.observations,
            landmark_ids=np.concatenate([placed, last.observations.landmark_ids[10:]]),
        ),
    )
    store.insert(40, 4, pose(4), last)

    landmarks = store.context(-1).landmarks

    assert np.isin(placed, landmarks.ids).all()
    np.testing.assert_array_equal(landmarks.positions_world[np.isin(landmarks.ids, placed)], 1.0)
    assert len(waiting(store, 10)) == 10


def blind(index: int) -> KeyframeData:
    """A keyframe without a surface."""
    none = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    return dataclasses.replace(keyframe(index), cloud_camera=none)


def test_a_keyframe_without_surface_is_near_to_those_that_saw_its_landmarks():
    store = walk(3)
    store.insert(30, 3, pose(3), blind(3))

    context = store.context(30)

    assert [keyframe.seq for keyframe in context.window] == [0, 10, 20, 30]
    assert len(context.cloud_world.points) > 1000


def test_it_takes_part_in_the_neighbourhood_of_others():
    store = walk(3)
    store.insert(30, 3, pose(3), blind(3))

    assert 30 in [keyframe.seq for keyframe in store.context(20).window]


def test_one_revision_and_reference_have_one_context():
    store = walk(10, noise_m=0.01)

    a, b = store.context(50), store.context(50)

    np.testing.assert_array_equal(a.cloud_world.points, b.cloud_world.points)
    np.testing.assert_array_equal(a.landmarks.ids, b.landmarks.ids)


def test_a_context_of_a_long_walk_is_built_in_time():
    store = walk(60)
    store.context(300)

    start = time.process_time()
    store.context(300)

    assert time.process_time() - start < 0.15  # a third of it on a quiet machine


def test_opposite_sides_of_a_thin_wall_are_not_averaged():
    front = wall_cloud()
    back = PointCloud(front.points + np.array([0, 0, 0.005], np.float32), -front.normals)

    merged = merge_clouds([front, back], [np.eye(4), np.eye(4)], 0.02, max_points=100)

    np.testing.assert_allclose(np.abs(merged.normals[:, 2]), 1.0)


@pytest.mark.parametrize(
    "change",
    [
        {"voxel_size_m": 0.0},
        {"max_keyframes": 0},
        {"max_landmarks": 0},
        {"max_waiting_keyframes": 0},
    ],
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ConfigError):
        ContextConfig(**change)


def test_voxels_beyond_the_limit_are_left_out_and_the_others_stay_the_same():
    rng = np.random.default_rng(5)
    points = rng.uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], (3000, 3)).astype(np.float32)
    cloud = PointCloud(points, np.tile(np.array([0.0, 0.0, -1.0], np.float32), (3000, 1)))

    all_of_it = merge_clouds([cloud], [np.eye(4)], 0.1, max_points=3000)
    some = merge_clouds([cloud], [np.eye(4)], 0.1, max_points=500)

    assert len(all_of_it.points) > 500
    np.testing.assert_array_equal(some.points, all_of_it.points[:500])
    np.testing.assert_array_equal(some.normals, all_of_it.normals[:500])
