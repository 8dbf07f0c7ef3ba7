"""Loops as values: one that was seen, what closing it changed, and both as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.graph import Way
from services.mapping.keyframes.loop_config import Bound
from shared.se3 import inverse, transform
from shared.tracks import KEYPOINT_BITS, Correction, KeyframeData, LoopConstraint

Matrix = NDArray[np.float64]
Poses = Mapping[int, Matrix]  # T_world_camera of all keyframes, by ascending seq


@dataclass(frozen=True)
class SeenLoop:
    """A constraint and the keyframe that brought it."""

    seq: int
    depth_m: float  # median of the scene as it saw it
    constraint: LoopConstraint

    def T_seen(self, poses: Poses) -> Matrix:
        """Where it says that the keyframe is, T_world_camera, [4, 4]."""
        return poses[self.constraint.earlier_seq] @ self.constraint.T_earlier_keyframe

    def misfit(self, poses: Poses) -> Matrix:
        """How far that is from where the keyframe is, in its own frame, [4, 4]."""
        return inverse(poses[self.seq]) @ self.T_seen(poses)

    def agrees_with(self, other: SeenLoop, poses: Poses, bound: Bound) -> bool:
        """Whether both move the world in the same way at this one's keyframe."""
        T_new_old = other.T_seen(poses) @ inverse(poses[other.seq])
        return bound.holds(inverse(T_new_old @ poses[self.seq]) @ self.T_seen(poses), Way())


@dataclass(frozen=True)
class Closing:
    """What a loop changes."""

    revision: int  # of the map from then on
    T_world_keyframes: Poses
    T_new_old: Poses  # how each keyframe moved, in the world
    landmark_ids: NDArray[np.int64]  # [P, 2], to keep and to drop

    def brought_up(self, T_world_camera: Matrix, data: KeyframeData) -> tuple[Matrix, KeyframeData]:
        """A keyframe that was tracked before this, as if it were after.

        It goes along with the keyframe it was tracked from; what it says of others is out of date.
        """
        assert data.link is not None
        T = self.T_new_old.get(data.link.reference_seq, np.eye(4))
        return T @ T_world_camera, replace(data, correction=_own(data.correction, T), loop=None)


def _own(correction: Correction, T_new_old: Matrix) -> Correction:
    """Of a correction only the keyframe that brings it (the last one) and its landmarks, moved."""
    own = correction.keyframe_seqs[-1:]
    is_own = (correction.landmark_ids >> KEYPOINT_BITS) == own
    return Correction(
        keyframe_seqs=own,
        T_world_keyframes=T_new_old @ correction.T_world_keyframes[-1:],
        landmark_ids=correction.landmark_ids[is_own],
        positions_world=transform(T_new_old, correction.positions_world[is_own]),
    )


def waiting_arrays(waiting: SeenLoop | None) -> dict[str, np.ndarray]:
    """A loop that waits for another one to agree, or none, for a snapshot."""
    loops = [] if waiting is None else [waiting]
    constraints = [loop.constraint for loop in loops]
    pairs = [c.landmark_ids for c in constraints]
    return {
        "waiting.seqs": np.array([(w.seq, w.constraint.earlier_seq) for w in loops], np.int64),
        "waiting.depth_m": np.array([w.depth_m for w in loops], np.float64),
        "waiting.T_earlier_keyframe": np.array([c.T_earlier_keyframe for c in constraints], float),
        "waiting.information": np.array([c.information for c in constraints], float),
        "waiting.landmark_ids": np.concatenate([np.zeros((0, 2), np.int64), *pairs]),
    }


def waiting_of(state: Mapping[str, np.ndarray]) -> SeenLoop | None:
    """What `waiting_arrays` named."""
    for seq, earlier_seq in state["waiting.seqs"].tolist():
        constraint = LoopConstraint(
            earlier_seq=earlier_seq,
            T_earlier_keyframe=state["waiting.T_earlier_keyframe"][0],
            information=state["waiting.information"][0],
            landmark_ids=state["waiting.landmark_ids"],
        )
        return SeenLoop(seq, float(state["waiting.depth_m"][0]), constraint)
    return None


def closing_arrays(last: Closing | None) -> dict[str, np.ndarray]:
    """The last closing, or none, for a snapshot."""
    moves = {} if last is None else last.T_new_old
    return {
        "closing.revision": np.array([] if last is None else [last.revision], np.int64),
        "closing.seqs": np.array(list(moves), np.int64),
        "closing.T_new_old": np.array(list(moves.values()), np.float64).reshape(-1, 4, 4),
    }


def closing_of(state: Mapping[str, np.ndarray]) -> Closing | None:
    """What `closing_arrays` named: enough to bring up a keyframe that comes late."""
    for revision in state["closing.revision"].tolist():
        seqs = state["closing.seqs"].tolist()
        moves = dict(zip(seqs, state["closing.T_new_old"], strict=True))
        return Closing(revision, {}, moves, np.zeros((0, 2), np.int64))
    return None
