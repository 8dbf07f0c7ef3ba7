import numpy as np
import pytest

from services.mapping.keyframes.retrieval import (
    RetrievalConfig,
    rank_keyframes,
    thumbnail_correlation,
)
from services.mapping.keyframes.stored import StoredKeyframe, ViewCone
from shared.errors import ConfigError
from shared.tracks import Observations, PointCloud


def stored(seq: int, thumbnail: np.ndarray, descriptors: np.ndarray) -> StoredKeyframe:
    count = len(descriptors)
    none = np.zeros((0, 3), np.float32)
    observations = Observations(
        np.full(count, -1, np.int64),
        np.zeros((count, 2), np.float32),
        np.zeros(count, np.uint8),
        np.zeros(count, np.float32),
        descriptors,
    )
    cloud = PointCloud(none, none)
    return StoredKeyframe(seq, 0, np.eye(4), observations, cloud, thumbnail, ViewCone.of(cloud))


def appearance(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    thumbnail = rng.integers(0, 256, (15, 20)).astype(np.uint8)
    return thumbnail, rng.integers(0, 256, (100, 32)).astype(np.uint8)


PLACES = [stored(seed, *appearance(seed)) for seed in range(20)]


@pytest.mark.parametrize("place", [0, 7, 19])
def test_a_place_seen_before_comes_first(place):
    ranked = rank_keyframes(*appearance(place), PLACES, RetrievalConfig())

    assert ranked[0].seq == place


def test_a_few_changed_bits_do_not_hide_a_place():
    thumbnail, descriptors = appearance(5)
    noisy = descriptors ^ np.uint8(1)  # a bit of every byte: 32 of 256

    assert rank_keyframes(thumbnail, noisy, PLACES, RetrievalConfig())[0].seq == 5


def test_thumbnails_are_compared_without_regard_to_exposure():
    thumbnail, _ = appearance(3)
    darker = (thumbnail * 0.5 + 20).astype(np.uint8)

    assert thumbnail_correlation(darker, thumbnail[None])[0] > 0.99


def test_a_black_frame_ranks_without_complaint():
    black = np.zeros((15, 20), np.uint8)

    ranked = rank_keyframes(black, np.zeros((0, 32), np.uint8), PLACES, RetrievalConfig())

    assert len(ranked) == len(PLACES)


def test_impossible_distances_are_refused():
    with pytest.raises(ConfigError):
        RetrievalConfig(max_hamming_bits=300)
