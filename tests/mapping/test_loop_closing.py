"""Loops at the owner of the map: keyframes of a walk around a block, with drift put in."""

import numpy as np
import pytest

from services.mapping.keyframes.loop_config import LoopConfig
from services.mapping.keyframes.store import KeyframeConfig, KeyframeStore
from shared.errors import NotFoundError
from shared.se3 import angle_rad, exp, inverse, transform
from shared.tracks import (
    Correction,
    KeyframeData,
    KeyframeLink,
    LoopConstraint,
    Observations,
    PointCloud,
    landmark_id,
)

LAP = 36
SEEN = 60  # landmarks that every keyframe founds
SHARED = 30  # and those of the one before that it sees again
DRIFT = exp([0.004, 0.001, 0.0, 0.0, 0.0015, 0.0])  # on every step, 14 cm and 3 degrees a lap


def true_pose(index: int) -> np.ndarray:
    """Once around in 36 keyframes, looking along the way."""
    step = exp([0.0, 0.0, 0.5, 0.0, 2.0 * np.pi / LAP, 0.0])
    return np.linalg.matrix_power(step, index)


def told_pose(index: int) -> np.ndarray:
    """The same with drift."""
    T = np.eye(4)
    for k in range(index):
        T = T @ inverse(true_pose(k)) @ true_pose(k + 1) @ DRIFT
    return T


def points_camera(index: int) -> np.ndarray:
    rng = np.random.default_rng(index)
    return rng.uniform([-1.0, -0.8, 1.8], [1.0, 0.8, 2.2], (SEEN, 3))


def data(index: int, pose: np.ndarray, link: KeyframeLink | None, **more) -> KeyframeData:
    """Keyframe 10 * index with its own landmarks and some of the one before."""
    own = landmark_id(10 * index, np.arange(SEEN))
    before = landmark_id(10 * (index - 1), np.arange(SHARED)) if index else own[:0]
    ids = np.concatenate([own, before])
    rng = np.random.default_rng(index % LAP)
    cloud = points_camera(index).astype(np.float32)
    return KeyframeData(
        observations=Observations(
            landmark_ids=ids,
            keypoints_px=rng.uniform(0, 400, (len(ids), 2)).astype(np.float32),
            octaves=np.zeros(len(ids), np.uint8),
            depths_m=np.full(len(ids), 2.0, np.float32),
            descriptors=rng.integers(0, 256, (len(ids), 32)).astype(np.uint8),
        ),
        landmark_normals_camera=np.tile(np.array([0, 0, -1], np.float32), (len(ids), 1)),
        cloud_camera=PointCloud(cloud, np.tile(np.array([0, 0, -1], np.float32), (SEEN, 1))),
        thumbnail=rng.integers(0, 256, (15, 20)).astype(np.uint8),
        correction=Correction(
            np.array([10 * index]), pose[None], own, transform(pose, points_camera(index))
        ),
        link=link,
        **more,
    )


def insert(store: KeyframeStore, index: int, loop: LoopConstraint | None = None) -> None:
    link = KeyframeLink(10 * (index - 1), store.revision, 1e6 * np.eye(6)) if index else None
    before = store.pose(10 * (index - 1)) if index else np.eye(4)
    step = inverse(told_pose(index - 1)) @ told_pose(index) if index else np.eye(4)
    pose = before @ step
    store.insert(10 * index, index, pose, data(index, pose, link, loop=loop))


def constraint(earlier: int, index: int, error: np.ndarray | None = None) -> LoopConstraint:
    """What a keyframe would measure in the map around an earlier one."""
    T = inverse(true_pose(earlier)) @ true_pose(index)
    same = np.column_stack(
        [landmark_id(10 * earlier, np.arange(20)), landmark_id(10 * index, np.arange(20))]
    )
    return LoopConstraint(10 * earlier, T if error is None else T @ error, 1e6 * np.eye(6), same)


def lap(config: LoopConfig | None = None) -> KeyframeStore:
    store = KeyframeStore(KeyframeConfig(loop=config or LoopConfig()))
    for index in range(LAP):
        insert(store, index)
    return store


def worst_error_m(store: KeyframeStore) -> float:
    poses = [store.pose(seq)[:3, 3] - true_pose(seq // 10)[:3, 3] for seq in store.seqs()]
    return float(np.linalg.norm(poses, axis=1).max())


@pytest.fixture(scope="module")
def state() -> dict[str, np.ndarray]:
    return lap().state()


@pytest.fixture
def store(state) -> KeyframeStore:
    """A lap that has drifted, about to come back to its first keyframe."""
    return KeyframeStore.from_state(state)


def close(store: KeyframeStore) -> None:
    insert(store, LAP, constraint(0, LAP))
    insert(store, LAP + 1, constraint(1, LAP + 1))


def test_two_keyframes_that_agree_close_a_loop(store):
    drifted = worst_error_m(store)

    close(store)

    assert store.num_loops == 2
    assert drifted > 0.1
    assert worst_error_m(store) < 0.35 * drifted


def test_the_last_keyframe_is_where_the_loop_says(store):
    close(store)

    error = inverse(true_pose(LAP + 1)) @ store.pose(10 * (LAP + 1))
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(angle_rad(error)) < 0.5


def test_one_keyframe_alone_waits(store):
    before = store.pose(0), store.pose(200)

    insert(store, LAP, constraint(0, LAP))

    assert store.num_loops == 0
    np.testing.assert_array_equal((store.pose(0), store.pose(200)), before)


def test_keyframes_that_disagree_close_nothing(store):
    off = exp([0.1, 0.0, -0.08, 0.0, 0.0, 0.0])

    insert(store, LAP, constraint(0, LAP))
    insert(store, LAP + 1, constraint(1, LAP + 1, off))

    assert store.num_loops == 0


def test_a_place_that_only_looks_alike_is_refused_however_often(store):
    before = store.poses().T_world_keyframes
    elsewhere = exp([0.0, 0.0, 4.0, 0.0, 0.0, 0.0])

    for index in range(LAP, LAP + 4):
        insert(store, index, constraint(index - LAP, index, elsewhere))

    assert store.num_loops == 0
    np.testing.assert_array_equal(store.poses().T_world_keyframes[: len(before)], before)


def test_a_loop_with_a_keyframe_that_is_not_there_is_passed_over(store):
    missing = LoopConstraint(7, np.eye(4), np.eye(6), np.zeros((0, 2), np.int64))

    insert(store, LAP, missing)

    assert len(store) == LAP + 1 and store.num_loops == 0


def test_landmarks_go_along_with_the_keyframe_that_founded_them(store):
    def seen_from(seq: int) -> np.ndarray:
        ids, positions = store.landmarks_seen_by(seq)
        own = positions[(ids >> 16) == seq]
        return transform(inverse(store.pose(seq)), own)

    before = seen_from(200)
    close(store)

    np.testing.assert_allclose(seen_from(200), before, atol=1e-9)


def test_one_point_is_one_landmark_afterwards(store):
    landmarks = store.num_landmarks()

    close(store)

    ids, _ = store.landmarks_seen_by(10 * LAP)
    assert set(landmark_id(0, np.arange(20)).tolist()) <= set(ids.tolist())
    assert store.num_landmarks() == landmarks + 2 * SEEN - 2 * 20


def test_both_passes_are_near_to_each_other_afterwards(store):
    far = store.loop_context(10 * (LAP - 1)).window
    close(store)

    near = store.loop_context(10 * (LAP + 1)).window

    assert 0 not in {k.seq for k in far}
    assert 0 in {k.seq for k in near}


def test_a_place_without_drift_is_joined_as_it_lies():
    store = KeyframeStore()
    for index in range(LAP):
        pose = true_pose(index)
        link = KeyframeLink(10 * (index - 1), store.revision, 1e6 * np.eye(6)) if index else None
        store.insert(10 * index, index, pose, data(index, pose, link))
    before = store.poses().T_world_keyframes

    pose = true_pose(LAP)
    link = KeyframeLink(10 * (LAP - 1), store.revision, 1e6 * np.eye(6))
    slightly_off = constraint(0, LAP, exp([0.005, 0.0, 0.0, 0.0, 0.002, 0.0]))
    store.insert(10 * LAP, LAP, pose, data(LAP, pose, link, loop=slightly_off))

    np.testing.assert_array_equal(store.poses().T_world_keyframes[:LAP], before)
    assert [0, 10 * LAP] in store.state()["graph.pairs"].tolist()
    assert store.num_loops == 0


def test_a_keyframe_tracked_before_the_loop_was_closed_follows_it(store):
    late = told_pose(LAP + 2)  # in the world as it was
    link = KeyframeLink(10 * (LAP + 1), store.revision, 1e6 * np.eye(6))
    step = inverse(told_pose(LAP + 1)) @ late
    close(store)
    corrected = store.poses().T_world_keyframes

    store.insert(10 * (LAP + 2), LAP + 2, late, data(LAP + 2, late, link))

    now = store.poses().T_world_keyframes
    np.testing.assert_array_equal(now[:-1], corrected)
    np.testing.assert_allclose(inverse(now[-2]) @ now[-1], step, atol=1e-9)


def test_a_map_taken_up_between_the_two_goes_on_to_the_bit(store):
    insert(store, LAP, constraint(0, LAP))
    other = KeyframeStore.from_state(store.state())

    for each in (store, other):
        insert(each, LAP + 1, constraint(1, LAP + 1))
        insert(each, LAP + 2)

    ours, theirs = store.state(), other.state()
    assert store.num_loops == other.num_loops == 2
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name], err_msg=name)


def test_a_map_saved_without_a_graph_gets_one(state, store):
    older = {name: array for name, array in state.items() if "seqs" in name or "." not in name}
    older |= {n: a for n, a in state.items() if n.startswith(("observations.", "landmarks."))}
    older = {n: a for n, a in older.items() if not n.startswith(("graph.", "waiting.", "closing."))}

    restored = KeyframeStore.from_state(older)

    close(restored)
    assert restored.num_loops == 2


def test_loops_that_are_turned_off_are_not_looked_for(state):
    config = KeyframeConfig(loop=LoopConfig(is_enabled=False))

    context = KeyframeStore.from_state(state, config).context(10 * (LAP - 1))

    assert len(context.loop_seqs) == 0


def test_the_place_of_an_unknown_keyframe_is_not_told(store):
    with pytest.raises(NotFoundError):
        store.loop_context(5)
