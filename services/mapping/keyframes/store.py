"""The keyframes of a session: poses, clouds, observations and landmarks, without their images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.arrays import (
    keyframe_arrays,
    keyframes_of,
    landmark_arrays,
    landmarks_of,
)
from services.mapping.keyframes.context import (
    ContextConfig,
    Neighbourhood,
    build_context,
    empty_context,
    landmarks_seen,
)
from services.mapping.keyframes.landmarks import corrected, dropped, moved, renamed, without
from services.mapping.keyframes.loop_candidates import loop_candidates
from services.mapping.keyframes.loop_closing import LoopCloser
from services.mapping.keyframes.loop_config import LoopConfig
from services.mapping.keyframes.loops import Poses, SeenLoop
from services.mapping.keyframes.retrieval import RetrievalConfig, nearest_view, rank_keyframes
from services.mapping.keyframes.stored import LandmarkTable, StoredKeyframe, ViewCone
from shared.errors import ConflictError, NotFoundError
from shared.se3 import rotate
from shared.tracks import (
    Candidate,
    Candidates,
    CandidatesRequest,
    Correction,
    KeyframeData,
    KeyframePoses,
    LoopConstraint,
    TrackingContext,
)


@dataclass(frozen=True)
class KeyframeConfig:
    """What the map serves to tracking."""

    context: ContextConfig = field(default_factory=ContextConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)


class KeyframeStore:
    """Keyframes by seq, and the landmarks they saw. Not locked: one thread at a time."""

    def __init__(self, config: KeyframeConfig | None = None) -> None:
        self.revision = 0
        self._config = config or KeyframeConfig()
        self._keyframes: dict[int, StoredKeyframe] = {}
        self._landmarks = LandmarkTable()
        self._loops = LoopCloser(self._config.loop)

    def __len__(self) -> int:
        return len(self._keyframes)

    def insert(
        self, seq: int, t_ns: int, T_world_camera: NDArray[np.float64], data: KeyframeData
    ) -> None:
        """Add a keyframe, apply its correction, close its loop; the revision grows by one.

        Raises:
            ConflictError: the seq is not above that of every keyframe here.
        """
        if self._keyframes and seq <= max(self._keyframes):
            raise ConflictError(f"keyframe {seq} is not newer than {max(self._keyframes)}")
        self.revision += 1
        T_world_camera, data = self._loops.brought_up(T_world_camera, data)
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
        self._move_keyframes(_by_seq(data.correction))
        normals_world = rotate(self.pose(seq), data.landmark_normals_camera)
        self._landmarks = corrected(self._landmarks, data, normals_world)
        self._drop(data.correction.outliers)
        poses = self._poses()
        self._loops.graph.follow(data.correction.keyframe_seqs.tolist(), poses)
        self._loops.link(self._keyframes[seq], data.link, poses)
        if data.loop is not None:
            self._close_loop(seq, data.loop)

    def _close_loop(self, seq: int, constraint: LoopConstraint) -> None:
        """Bend the graph where the constraint is believed; one place has its landmarks once."""
        if constraint.earlier_seq not in self._keyframes:
            return
        seen = SeenLoop(seq, self._keyframe(seq).cone.median_m, constraint)
        closing = self._loops.close(seen, self._poses(), self.revision)
        if closing is None:
            return
        self._move_keyframes(closing.T_world_keyframes)
        self._landmarks = moved(self._landmarks, closing.T_new_old)
        self._landmarks = without(self._landmarks, closing.landmark_ids[:, 1])
        for keyframe in list(self._keyframes.values()):
            observations = renamed(keyframe.observations, closing.landmark_ids)
            self._keyframes[keyframe.seq] = replace(keyframe, observations=observations)

    def _drop(self, outliers: NDArray[np.int64]) -> None:
        """Forget observations that the adjustment refuted."""
        for seq in np.unique(outliers[:, 0]).tolist():
            if seq in self._keyframes:
                keyframe = self._keyframes[seq]
                seen = dropped(keyframe.observations, outliers[outliers[:, 0] == seq, 1])
                self._keyframes[seq] = replace(keyframe, observations=seen)

    def _move_keyframes(self, T_world_keyframes: Poses) -> None:
        for seq, T_world_camera in T_world_keyframes.items():
            if seq in self._keyframes:
                moved = replace(self._keyframes[seq], T_world_camera=T_world_camera)
                self._keyframes[seq] = moved

    def _poses(self) -> dict[int, NDArray[np.float64]]:
        return {seq: keyframe.T_world_camera for seq, keyframe in self._keyframes.items()}

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
            loops=self.num_loops,
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

    @property
    def num_loops(self) -> int:
        """Places that were seen again and joined."""
        return self._loops.graph.num_loops

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
        loop_seqs = self._loop_candidates(known)
        return self._context(known, list(self._keyframes.values()), loop_seqs)

    def loop_context(self, seq: int) -> TrackingContext:
        """The neighbourhood of a keyframe, of what is near to it in the graph only.

        Raises:
            NotFoundError: no such keyframe.
        """
        self._keyframe(seq)
        return self._context(seq, self._near_and_far(seq)[0], [])

    def _context(
        self, reference_seq: int, near: list[StoredKeyframe], loop_seqs: list[int]
    ) -> TrackingContext:
        around = Neighbourhood(
            reference=self._keyframes[reference_seq],
            near=near,
            first_seq=next(iter(self._keyframes)),
            num_keyframes=len(self._keyframes),
            loop_seqs=loop_seqs,
        )
        return build_context(around, self._landmarks, self.revision, self._config.context)

    def _loop_candidates(self, reference_seq: int) -> list[int]:
        config = self._config.loop
        if not config.is_enabled:
            return []
        _, far = self._near_and_far(reference_seq)
        return loop_candidates(self._keyframes[reference_seq], far, config.candidates)

    def _near_and_far(self, seq: int) -> tuple[list[StoredKeyframe], list[StoredKeyframe]]:
        near_seqs = self._loops.near(seq)
        keyframes = self._keyframes.values()
        near = [keyframe for keyframe in keyframes if keyframe.seq in near_seqs]
        return near, [keyframe for keyframe in keyframes if keyframe.seq not in near_seqs]

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
        chosen = ranked[: max(0, request.limit)]
        if request.T_world_prior is not None:
            expected = nearest_view(request.T_world_prior, ranked)
            chosen = [expected, *(k for k in chosen if k.seq != expected.seq)]
        return Candidates(self.revision, tuple(self._candidate(k) for k in chosen))

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
        return {
            "revision": np.array([self.revision], np.int64),
            **keyframe_arrays(list(self._keyframes.values())),
            **landmark_arrays(self._landmarks),
            **self._loops.state(),
        }

    @classmethod
    def from_state(
        cls, state: Mapping[str, np.ndarray], config: KeyframeConfig | None = None
    ) -> KeyframeStore:
        """The store that `state` came from."""
        store = cls(config)
        store.revision = int(state["revision"][0])
        store._landmarks = landmarks_of(state)
        store._keyframes = keyframes_of(state)
        if "graph.pairs" in state:  # else it is of a version without loops
            store._loops.restore(state)
        else:
            store._loops.link_all(store._keyframes)
        return store


def _by_seq(correction: Correction) -> dict[int, NDArray[np.float64]]:
    return dict(zip(correction.keyframe_seqs.tolist(), correction.T_world_keyframes, strict=True))
