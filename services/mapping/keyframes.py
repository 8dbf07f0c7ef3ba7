"""The keyframes of a session: poses, clouds, observations and landmarks, without their images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.context import (
    ContextConfig,
    LandmarkTable,
    StoredKeyframe,
    ViewCone,
    build_context,
    empty_context,
    landmarks_seen,
)
from services.mapping.retrieval import RetrievalConfig, rank_keyframes
from shared.errors import ConflictError, NotFoundError
from shared.se3 import rotate
from shared.tracks import (
    Candidate,
    Candidates,
    CandidatesRequest,
    Correction,
    KeyframeData,
    KeyframePoses,
    Observations,
    PointCloud,
    TrackingContext,
)


@dataclass(frozen=True)
class KeyframeConfig:
    """What the map serves to tracking."""

    context: ContextConfig = field(default_factory=ContextConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)


class KeyframeStore:
    """Keyframes by seq, and the landmarks they saw. Not locked: one thread at a time."""

    def __init__(self, config: KeyframeConfig | None = None) -> None:
        self.revision = 0
        self._config = config or KeyframeConfig()
        self._keyframes: dict[int, StoredKeyframe] = {}
        self._landmarks = LandmarkTable()

    def __len__(self) -> int:
        return len(self._keyframes)

    def insert(
        self, seq: int, t_ns: int, T_world_camera: NDArray[np.float64], data: KeyframeData
    ) -> None:
        """Add a keyframe and apply its correction; the revision grows by one.

        Raises:
            ConflictError: the seq is not above that of every keyframe here.
        """
        if self._keyframes and seq <= max(self._keyframes):
            raise ConflictError(f"keyframe {seq} is not newer than {max(self._keyframes)}")
        self._keyframes[seq] = StoredKeyframe(
            seq=seq,
            t_ns=t_ns,
            T_world_camera=T_world_camera,
            observations=data.observations,
            cloud_camera=data.cloud_camera,
            thumbnail=data.thumbnail,
            cone=ViewCone.of(data.cloud_camera),
            edge_blur_px=data.edge_blur_px,
        )
        self._move_keyframes(data.correction)
        self._landmarks = _corrected(
            self._landmarks, data, rotate(self.pose(seq), data.landmark_normals_camera)
        )
        self.revision += 1

    def _move_keyframes(self, correction: Correction) -> None:
        poses = zip(correction.keyframe_seqs, correction.T_world_keyframes, strict=True)
        for seq, T_world_camera in poses:
            if int(seq) in self._keyframes:
                moved = replace(self._keyframes[int(seq)], T_world_camera=T_world_camera)
                self._keyframes[int(seq)] = moved

    def pose(self, seq: int) -> NDArray[np.float64]:
        """Present pose of a keyframe, [4, 4].

        Raises:
            NotFoundError: no such keyframe.
        """
        return self._keyframe(seq).T_world_camera

    def poses(self) -> KeyframePoses:
        """Present poses of all keyframes."""
        poses = [keyframe.T_world_camera for keyframe in self._keyframes.values()]
        return KeyframePoses(
            revision=self.revision,
            seqs=np.array(self.seqs(), np.int64),
            T_world_keyframes=np.array(poses, np.float64).reshape(-1, 4, 4),
        )

    def seqs(self) -> list[int]:
        """Seqs of all keyframes, ascending."""
        return list(self._keyframes)

    def landmarks_seen_by(self, seq: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids [M] and present positions in the world [M, 3] of the landmarks a keyframe saw.

        Raises:
            NotFoundError: no such keyframe.
        """
        ids = self._known_ids(self._keyframe(seq))
        return ids, self._landmarks.positions_world[self._landmarks.rows(ids)]

    def num_landmarks(self) -> int:
        """Number of landmarks of the map."""
        return len(self._landmarks.ids)

    def context(self, reference_seq: int) -> TrackingContext:
        """The neighbourhood of a keyframe; of the newest one where there is none of that seq.

        Empty (num_keyframes 0) when there are no keyframes.
        """
        if not self._keyframes:
            return empty_context(self.revision)
        known = reference_seq if reference_seq in self._keyframes else max(self._keyframes)
        return build_context(
            self._keyframes, self._landmarks, known, self.revision, self._config.context
        )

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """The keyframes that look most like a frame, with the landmarks they saw."""
        if not self._keyframes:
            return Candidates(self.revision, ())
        ranked = rank_keyframes(
            request.thumbnail,
            request.descriptors,
            list(self._keyframes.values()),
            self._config.retrieval,
        )
        return Candidates(
            self.revision, tuple(self._candidate(k) for k in ranked[: max(0, request.limit)])
        )

    def _candidate(self, keyframe: StoredKeyframe) -> Candidate:
        landmarks = landmarks_seen(self._landmarks, [keyframe], self._known_ids(keyframe))
        return Candidate(keyframe.seq, keyframe.T_world_camera, landmarks)

    def _keyframe(self, seq: int) -> StoredKeyframe:
        if seq not in self._keyframes:
            raise NotFoundError(f"no keyframe {seq}")
        return self._keyframes[seq]

    def _known_ids(self, keyframe: StoredKeyframe) -> NDArray[np.int64]:
        ids = np.unique(keyframe.observations.landmark_ids)
        return ids[self._landmarks.rows(ids) >= 0]

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a snapshot."""
        keyframes = list(self._keyframes.values())
        poses = self.poses()
        return {
            "revision": np.array([self.revision], np.int64),
            "seqs": poses.seqs,
            "t_ns": np.array([k.t_ns for k in keyframes], np.int64),
            "T_world_keyframes": poses.T_world_keyframes,
            "edge_blurs_px": np.array([k.edge_blur_px for k in keyframes], np.float64),
            "thumbnails": _joined([k.thumbnail[None] for k in keyframes], (0, 15, 20), np.uint8),
            "num_points": np.array([len(k.cloud_camera.points) for k in keyframes], np.int64),
            "points": _joined([k.cloud_camera.points for k in keyframes], (0, 3), np.float32),
            "normals": _joined([k.cloud_camera.normals for k in keyframes], (0, 3), np.float32),
            "num_features": np.array(
                [len(k.observations.landmark_ids) for k in keyframes], np.int64
            ),
            **{
                f"observations.{name}": _joined(
                    [getattr(k.observations, name) for k in keyframes], shape, dtype
                )
                for name, shape, dtype in _OBSERVATION_ARRAYS
            },
            "landmarks.ids": self._landmarks.ids,
            "landmarks.positions_world": self._landmarks.positions_world,
            "landmarks.normals_world": self._landmarks.normals_world,
        }

    @classmethod
    def from_state(
        cls, state: Mapping[str, np.ndarray], config: KeyframeConfig | None = None
    ) -> KeyframeStore:
        """The store that `state` came from."""
        store = cls(config)
        store.revision = int(state["revision"][0])
        store._landmarks = LandmarkTable(
            state["landmarks.ids"],
            state["landmarks.positions_world"],
            state["landmarks.normals_world"],
        )
        points_end = np.cumsum(state["num_points"])
        features_end = np.cumsum(state["num_features"])
        for i, seq in enumerate(state["seqs"].tolist()):
            points = slice(int(points_end[i] - state["num_points"][i]), int(points_end[i]))
            features = slice(int(features_end[i] - state["num_features"][i]), int(features_end[i]))
            store._keyframes[seq] = _stored(state, i, points, features)
        return store


_OBSERVATION_ARRAYS: tuple[tuple[str, tuple[int, ...], type], ...] = (
    ("landmark_ids", (0,), np.int64),
    ("keypoints_px", (0, 2), np.float32),
    ("octaves", (0,), np.uint8),
    ("depths_m", (0,), np.float32),
    ("descriptors", (0, 32), np.uint8),
)


def _joined(parts: list[np.ndarray], empty_shape: tuple[int, ...], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(empty_shape, dtype), *parts])


def _stored(
    state: Mapping[str, np.ndarray], index: int, points: slice, features: slice
) -> StoredKeyframe:
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


def _corrected(
    table: LandmarkTable, data: KeyframeData, normals_world: NDArray[np.float32]
) -> LandmarkTable:
    """The table with the correction's positions; ids that it lacks are added with their normals."""
    correction = data.correction
    rows = table.rows(correction.landmark_ids)
    is_new = rows < 0
    positions = table.positions_world.copy()
    positions[rows[~is_new]] = correction.positions_world[~is_new]
    new_ids, first = np.unique(correction.landmark_ids[is_new], return_index=True)
    normals = np.zeros((len(new_ids), 3), np.float32)
    if len(new_ids):
        observed = data.observations.landmark_ids
        at = np.minimum(np.searchsorted(new_ids, observed), len(new_ids) - 1)
        mine = np.flatnonzero(new_ids[at] == observed)
        normals[at[mine]] = normals_world[mine]
    ids = np.concatenate([table.ids, new_ids])
    order = np.argsort(ids, kind="stable")
    return LandmarkTable(
        ids=ids[order],
        positions_world=np.concatenate([positions, correction.positions_world[is_new][first]])[
            order
        ],
        normals_world=np.concatenate([table.normals_world, normals])[order],
    )
