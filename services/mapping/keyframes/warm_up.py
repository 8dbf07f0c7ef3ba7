"""Compile, or load from the cache, the kernels of the geometric side of the map."""

from __future__ import annotations

import numpy as np

from services.mapping.keyframes.retrieval import count_alike
from services.mapping.keyframes.store import KeyframeStore
from shared import codec
from shared.tracks import Correction, KeyframeData, Observations, PointCloud

_COUNT = 8


def warm_up() -> None:
    """A context of one keyframe that came over the bus, and a look for others like it."""
    data = codec.unpack(KeyframeData, codec.pack(_keyframe()))
    store = KeyframeStore()
    store.insert(0, 0, np.eye(4), data)
    store.context(0)
    descriptors = data.observations.descriptors
    for most in (_COUNT, _COUNT // 2):  # as they are, and a copy of some
        count_alike(descriptors, descriptors, most, 0)


def _keyframe() -> KeyframeData:
    points = np.random.default_rng(0).uniform(1.0, 2.0, (_COUNT, 3)).astype(np.float32)
    towards = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (_COUNT, 1))
    seen = Observations(
        landmark_ids=np.arange(_COUNT),
        keypoints_px=points[:, :2],
        octaves=np.zeros(_COUNT, np.uint8),
        depths_m=points[:, 2],
        descriptors=np.zeros((_COUNT, 32), np.uint8),
    )
    poses, ids = np.eye(4)[None], np.arange(_COUNT)
    return KeyframeData(
        observations=seen,
        landmark_normals_camera=towards,
        cloud_camera=PointCloud(points, towards),
        thumbnail=np.zeros((15, 20), np.uint8),
        correction=Correction(np.zeros(1, np.int64), poses, ids, points.astype(np.float64)),
    )
