import dataclasses

import numpy as np
import pytest

from services.mapping.keyframes.store import KeyframeStore
from shared.errors import ConflictError, NotFoundError
from shared.se3 import exp
from shared.tracks import (
    NO_LANDMARK,
    CandidatesRequest,
    Correction,
    KeyframeData,
    Observations,
    PointCloud,
    landmark_id,
)

POSE = exp([0.1, 0.0, 0.0, 0.0, 0.1, 0.0])


def keyframe(seq: int, landmark_ids: np.ndarray, correction: Correction) -> KeyframeData:
    """A wall 2 m ahead with one feature a landmark; appearance follows from the seq."""
    rng = np.random.default_rng(seq)
    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-0.8, 0.8, 30))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1).astype(np.float32)
    count = len(landmark_ids)
    return KeyframeData(
        observations=Observations(
            landmark_ids=landmark_ids,
            keypoints_px=rng.uniform(0, 400, (count, 2)).astype(np.float32),
            octaves=rng.integers(0, 8, count).astype(np.uint8),
            depths_m=np.full(count, 2.0, np.float32),
            descriptors=rng.integers(0, 256, (count, 32)).astype(np.uint8),
        ),
        landmark_normals_camera=np.tile(np.array([0, 0, -1], np.float32), (count, 1)),
        cloud_camera=PointCloud(
            points, np.tile(np.array([0, 0, -1], np.float32), (len(points), 1))
        ),
        thumbnail=rng.integers(0, 256, (15, 20)).astype(np.uint8),
        correction=correction,
    )


def correction(seqs: list[int], poses: np.ndarray, ids: np.ndarray, value: float) -> Correction:
    positions = np.full((len(ids), 3), value)
    return Correction(np.array(seqs, np.int64), poses, ids, positions)


@pytest.fixture
def store() -> KeyframeStore:
    """Keyframes 0 and 10; the second sees 20 landmarks of the first and founds 10."""
    store = KeyframeStore()
    first = landmark_id(0, np.arange(30))
    store.insert(0, 0, np.eye(4), keyframe(0, first, correction([0], np.eye(4)[None], first, 1.0)))
    new = landmark_id(10, np.arange(10))
    seen = np.concatenate([first[:20], new, np.full(5, NO_LANDMARK)])
    moved = np.concatenate([first[:5], new])
    store.insert(
        10,
        330_000_000,
        POSE,
        keyframe(10, seen, correction([0, 10], np.stack([exp([0.01] * 6), POSE]), moved, 2.0)),
    )
    return store


def test_a_new_store_is_empty():
    store = KeyframeStore()

    assert (len(store), store.revision, store.num_landmarks()) == (0, 0, 0)
    assert store.seqs() == []
    assert store.poses().T_world_keyframes.shape == (0, 4, 4)


def test_every_keyframe_raises_the_revision(store):
    assert store.revision == 2
    assert store.seqs() == [0, 10]
    assert len(store) == 2


def test_a_correction_moves_earlier_keyframes(store):
    np.testing.assert_array_equal(store.pose(0), exp([0.01] * 6))
    np.testing.assert_array_equal(store.pose(10), POSE)
    np.testing.assert_array_equal(store.poses().T_world_keyframes[0], exp([0.01] * 6))


def test_observations_that_a_correction_refutes_are_forgotten(store):
    new = landmark_id(20, np.arange(3))
    outliers = np.array([(0, 4), (10, 4), (10, 6), (99, 5)], np.int64)  # 99: not here any more
    refuting = dataclasses.replace(correction([20], POSE[None], new, 3.0), outliers=outliers)

    store.insert(20, 1, POSE, keyframe(20, new, refuting))

    assert 4 not in store.landmarks_seen_by(0)[0]
    assert np.isin([4, 6], store.landmarks_seen_by(10)[0]).tolist() == [False, False]
    assert np.isin([5, 6, 7], store.landmarks_seen_by(0)[0]).all()


def test_a_correction_moves_and_adds_landmarks(store):
    ids, positions = store.landmarks_seen_by(0)

    assert store.num_landmarks() == 40
    assert ids.tolist() == list(range(30))
    np.testing.assert_array_equal(positions[:5], 2.0)
    np.testing.assert_array_equal(positions[5:], 1.0)


def test_features_without_a_landmark_are_not_told(store):
    ids, _ = store.landmarks_seen_by(10)

    assert len(ids) == 30
    assert (ids >= 0).all()


@pytest.mark.parametrize("seq", [10, 3])
def test_a_keyframe_out_of_order_is_refused(store, seq):
    data = keyframe(
        seq,
        landmark_id(seq, np.arange(3)),
        correction([], np.zeros((0, 4, 4)), np.zeros(0, np.int64), 0.0),
    )

    with pytest.raises(ConflictError):
        store.insert(seq, 0, np.eye(4), data)


def test_an_unknown_keyframe_is_named(store):
    with pytest.raises(NotFoundError, match="keyframe 7"):
        store.pose(7)


def test_the_state_holds_everything(store):
    twin = KeyframeStore.from_state(store.state())

    state, twin_state = store.state(), twin.state()
    assert state.keys() == twin_state.keys()
    for name, value in state.items():
        np.testing.assert_array_equal(value, twin_state[name], err_msg=name)
        assert value.dtype == twin_state[name].dtype, name


def test_an_empty_store_comes_back_from_its_state():
    twin = KeyframeStore.from_state(KeyframeStore().state())

    assert (len(twin), twin.num_landmarks()) == (0, 0)


def test_a_restored_store_serves_the_same_context(store):
    a = store.context(10)
    b = KeyframeStore.from_state(store.state()).context(10)

    np.testing.assert_array_equal(a.cloud_world.points, b.cloud_world.points)
    np.testing.assert_array_equal(a.landmarks.descriptors, b.landmarks.descriptors)
    assert [k.seq for k in a.window] == [k.seq for k in b.window]


def test_a_restored_store_goes_on(store):
    twin = KeyframeStore.from_state(store.state())
    ids = landmark_id(20, np.arange(5))

    twin.insert(20, 0, POSE, keyframe(20, ids, correction([20], POSE[None], ids, 3.0)))

    assert twin.revision == 3
    assert twin.num_landmarks() == 45


def test_candidates_come_with_their_landmarks(store):
    looks_like_10 = keyframe(
        10, np.zeros(35, np.int64), correction([], np.zeros((0, 4, 4)), np.zeros(0, np.int64), 0.0)
    )
    request = CandidatesRequest(looks_like_10.thumbnail, looks_like_10.observations.descriptors, 1)

    (candidate,) = store.candidates(request).keyframes

    assert candidate.seq == 10
    assert len(candidate.landmarks.ids) == 30
    np.testing.assert_array_equal(candidate.T_world_camera, POSE)


def test_an_empty_store_has_no_candidates():
    request = CandidatesRequest(np.zeros((15, 20), np.uint8), np.zeros((0, 32), np.uint8))

    assert KeyframeStore().candidates(request).keyframes == ()
