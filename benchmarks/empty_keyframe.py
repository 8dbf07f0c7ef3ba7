"""What a keyframe without content brings to the map."""

from __future__ import annotations

import numpy as np

from shared.tracks import Correction, KeyframeData, Observations, PointCloud


def empty_keyframe() -> KeyframeData:
    """No features, no points, no correction."""
    nothing = np.zeros((0, 3), np.float32)
    observations = Observations(
        landmark_ids=np.zeros(0, np.int64),
        keypoints_px=np.zeros((0, 2), np.float32),
        octaves=np.zeros(0, np.uint8),
        depths_m=np.zeros(0, np.float32),
        descriptors=np.zeros((0, 32), np.uint8),
    )
    correction = Correction(
        keyframe_seqs=np.zeros(0, np.int64),
        T_world_keyframes=np.zeros((0, 4, 4)),
        landmark_ids=np.zeros(0, np.int64),
        positions_world=np.zeros((0, 3)),
    )
    thumbnail = np.zeros((15, 20), np.uint8)
    return KeyframeData(observations, nothing, PointCloud(nothing, nothing), thumbnail, correction)
