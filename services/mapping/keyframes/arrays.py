"""Keyframes and landmarks as named arrays, for a snapshot, and back."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from services.mapping.keyframes.stored import LandmarkTable, StoredKeyframe, ViewCone
from shared.tracks import Observations, PointCloud

Arrays = Mapping[str, np.ndarray]

_OBSERVATION_ARRAYS: tuple[tuple[str, tuple[int, ...], type], ...] = (
    ("landmark_ids", (0,), np.int64),
    ("keypoints_px", (0, 2), np.float32),
    ("octaves", (0,), np.uint8),
    ("depths_m", (0,), np.float32),
    ("descriptors", (0, 32), np.uint8),
)


def keyframe_arrays(keyframes: list[StoredKeyframe]) -> dict[str, np.ndarray]:
    """All of the keyframes."""
    poses = [keyframe.T_world_camera for keyframe in keyframes]
    return {
        "seqs": np.array([k.seq for k in keyframes], np.int64),
        "t_ns": np.array([k.t_ns for k in keyframes], np.int64),
        "T_world_keyframes": np.array(poses, np.float64).reshape(-1, 4, 4),
        "edge_blurs_px": np.array([k.edge_blur_px for k in keyframes], np.float64),
        "thumbnails": _joined([k.thumbnail[None] for k in keyframes], (0, 15, 20), np.uint8),
        "num_points": np.array([len(k.cloud_camera.points) for k in keyframes], np.int64),
        "points": _joined([k.cloud_camera.points for k in keyframes], (0, 3), np.float32),
        "normals": _joined([k.cloud_camera.normals for k in keyframes], (0, 3), np.float32),
        "num_features": np.array([len(k.observations.landmark_ids) for k in keyframes], np.int64),
        **{
            f"observations.{name}": _joined(
                [getattr(k.observations, name) for k in keyframes], shape, dtype
            )
            for name, shape, dtype in _OBSERVATION_ARRAYS
        },
    }


def keyframes_of(state: Arrays) -> dict[int, StoredKeyframe]:
    """The keyframes that `keyframe_arrays` named, by seq."""
    points_end = np.cumsum(state["num_points"])
    features_end = np.cumsum(state["num_features"])
    keyframes = {}
    for i, seq in enumerate(state["seqs"].tolist()):
        points = slice(int(points_end[i] - state["num_points"][i]), int(points_end[i]))
        features = slice(int(features_end[i] - state["num_features"][i]), int(features_end[i]))
        keyframes[seq] = _stored(state, i, points, features)
    return keyframes


def landmark_arrays(table: LandmarkTable) -> dict[str, np.ndarray]:
    """All landmarks."""
    return {
        "landmarks.ids": table.ids,
        "landmarks.positions_world": table.positions_world,
        "landmarks.normals_world": table.normals_world,
    }


def landmarks_of(state: Arrays) -> LandmarkTable:
    """The landmarks that `landmark_arrays` named."""
    return LandmarkTable(
        state["landmarks.ids"],
        state["landmarks.positions_world"],
        state["landmarks.normals_world"],
    )


def _joined(parts: list[np.ndarray], empty_shape: tuple[int, ...], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(empty_shape, dtype), *parts])


def _stored(state: Arrays, index: int, points: slice, features: slice) -> StoredKeyframe:
    cloud = PointCloud(state["points"][points], state["normals"][points])
    observations = {
        name: state[f"observations.{name}"][features] for name, _, _ in _OBSERVATION_ARRAYS
    }
    return StoredKeyframe(
        seq=int(state["seqs"][index]),
        t_ns=int(state["t_ns"][index]),
        T_world_camera=state["T_world_keyframes"][index],
        observations=Observations(**observations),
        cloud_camera=cloud,
        thumbnail=state["thumbnails"][index],
        cone=ViewCone.of(cloud),
        edge_blur_px=float(state["edge_blurs_px"][index]) if "edge_blurs_px" in state else 0.0,
    )
