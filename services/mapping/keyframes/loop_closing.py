"""Places seen again: which constraints are believed, and what then moves."""

from __future__ import annotations

import logging
import math
from collections.abc import KeysView, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.graph import Edge, EdgeKind, KeyframeGraph, Way, linked_keyframes
from services.mapping.keyframes.landmarks import one_to_one
from services.mapping.keyframes.loop_config import LoopConfig
from services.mapping.keyframes.loops import (
    Closing,
    Poses,
    SeenLoop,
    closing_arrays,
    closing_of,
    waiting_arrays,
    waiting_of,
)
from services.mapping.keyframes.pose_graph import PoseGraph, solve_pose_graph
from services.mapping.keyframes.stored import StoredKeyframe
from shared.se3 import angle_rad, inverse
from shared.tracks import KeyframeData, KeyframeLink

LOGGER = logging.getLogger(__name__)
Matrix = NDArray[np.float64]
_UNTOLD = 1e4  # information of a keyframe from an older log: a centimetre


class LoopCloser:
    """The graph of a map's keyframes, and the loop that waits for another one to agree."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self.graph = KeyframeGraph()
        self._waiting: SeenLoop | None = None
        self._last: Closing | None = None

    def near(self, seq: int) -> KeysView[int]:
        """Seqs of the keyframes that drift does not set apart from one."""
        return self.graph.ways_from(seq, self._config.near_views).keys()

    def link(self, keyframe: StoredKeyframe, link: KeyframeLink | None, poses: Poses) -> None:
        """Join a new keyframe with the one it was tracked from and those it shares most with."""
        config, ids = self._config, keyframe.observations.landmark_ids
        others = linked_keyframes(ids, keyframe.seq, config.min_shared, config.max_links)
        if link is not None:
            others = [link.reference_seq, *others]
        earlier = [seq for seq in poses if seq < keyframe.seq]
        known = [seq for seq in dict.fromkeys(others) if seq in earlier] or earlier[-1:]
        information = link.information if link is not None else _UNTOLD * np.eye(6)
        for seq in known:
            self.graph.add(self._edge(seq, keyframe, poses, information))

    def link_all(self, keyframes: Mapping[int, StoredKeyframe]) -> None:
        """Join the keyframes of a map that was saved without a graph."""
        poses = {seq: keyframe.T_world_camera for seq, keyframe in keyframes.items()}
        for keyframe in keyframes.values():
            self.link(keyframe, None, poses)

    def _edge(self, first: int, second: StoredKeyframe, poses: Poses, information: Matrix) -> Edge:
        """As sure as registration says, less the drift of its way."""
        T = inverse(poses[first]) @ second.T_world_camera
        edge = Edge(first, second.seq, T, information, EdgeKind.TRACKED, second.cone.median_m)
        sigma = self._config.drift_sigma
        noisy = _with_noise(information, sigma.metres(edge.way), sigma.radians(edge.way))
        return replace(edge, information=noisy)

    def close(self, seen: SeenLoop, poses: Poses, revision: int) -> Closing | None:
        """Close the loop, with the one that waited for it; None where nothing moves (yet)."""
        if self._config.unmoved.holds(seen.misfit(poses), Way()):
            self._join(seen, poses)
            return None
        loops = self._believed(seen, poses)
        if not loops:
            return None
        before = self.graph.copy()
        for loop in loops:
            self.graph.add(self._loop_edge(loop))
        solved = solve_pose_graph(pose_graph(self.graph, poses), self._config.graph)
        closed = dict(zip(poses, solved, strict=True))
        if not all(self._config.remainder.holds(loop.misfit(closed), Way()) for loop in loops):
            self.graph = before  # the rest of the graph resists it
            return None
        _report(seen, poses, closed)
        T_new_old = {seq: T @ inverse(poses[seq]) for seq, T in closed.items()}
        pairs = np.concatenate([loop.constraint.landmark_ids for loop in loops])
        self._last = Closing(revision, closed, T_new_old, one_to_one(pairs))
        return self._last

    def brought_up(self, T_world_camera: Matrix, data: KeyframeData) -> tuple[Matrix, KeyframeData]:
        """A keyframe as it is after the last closing, which its tracker may not have known of."""
        last = self._last
        if last is None or data.link is None or data.link.map_revision >= last.revision:
            return T_world_camera, data
        return last.brought_up(T_world_camera, data)

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a snapshot."""
        return {**self.graph.state(), **waiting_arrays(self._waiting), **closing_arrays(self._last)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take up a `state()`."""
        self.graph.restore(state)
        self._waiting = waiting_of(state)
        self._last = closing_of(state)

    def _believed(self, seen: SeenLoop, poses: Poses) -> list[SeenLoop]:
        """The loops to be closed now: none, the one seen, or the one that waited for it too."""
        way = self.graph.ways_from(seen.seq).get(seen.constraint.earlier_seq)
        misfit, config = seen.misfit(poses), self._config
        if way is None or not config.possible.holds(misfit, way):
            return []
        before, self._waiting = self._waiting, None
        if before is not None and seen.agrees_with(before, poses, config.agreement):
            return [before, seen]
        if config.expected.holds(misfit, way):
            return [seen]
        self._waiting = seen
        return []

    def _join(self, seen: SeenLoop, poses: Poses) -> None:
        """Without drift the two passes are near to each other from here on, as they lie."""
        measured = self._loop_edge(seen)
        T = inverse(poses[measured.first]) @ poses[measured.second]
        self.graph.add(replace(measured, T_first_second=T, kind=EdgeKind.JOINED))

    def _loop_edge(self, loop: SeenLoop) -> Edge:
        c, sigma = loop.constraint, self._config.loop_sigma
        return Edge(
            first=c.earlier_seq,
            second=loop.seq,
            T_first_second=c.T_earlier_keyframe,
            information=_with_noise(c.information, sigma.metres(Way()), sigma.radians(Way())),
            kind=EdgeKind.LOOP,
            depth_m=loop.depth_m,
        )


def _with_noise(information: Matrix, sigma_m: float, sigma_rad: float) -> Matrix:
    """Of a twist with more noise; what nothing is known of has a sigma of a metre or a radian."""
    noise = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
    return np.asarray(np.linalg.inv(np.linalg.inv(information + np.eye(6)) + noise), np.float64)


def pose_graph(graph: KeyframeGraph, poses: Poses) -> PoseGraph:
    """The graph as arrays; the oldest keyframe holds the world in place."""
    row = {seq: n for n, seq in enumerate(poses)}
    edges = graph.edges
    return PoseGraph(
        T_world_poses=np.array(list(poses.values())),
        first=np.array([row[edge.first] for edge in edges], np.int64),
        second=np.array([row[edge.second] for edge in edges], np.int64),
        T_first_second=np.array([edge.T_first_second for edge in edges]),
        information=np.array([edge.information for edge in edges]),
        is_robust=np.array([edge.kind is EdgeKind.LOOP for edge in edges], np.bool_),
    )


def _report(loop: SeenLoop, before: Poses, after: Poses) -> None:
    shift_m = max(float(np.linalg.norm(after[s][:3, 3] - before[s][:3, 3])) for s in before)
    misfit = loop.misfit(before)
    LOGGER.info(
        "loop closed: keyframe %d is back at %d, off by %.1f cm and %.2f deg; keyframes moved by "
        "up to %.1f cm",
        loop.seq,
        loop.constraint.earlier_seq,
        100.0 * float(np.linalg.norm(misfit[:3, 3])),
        math.degrees(angle_rad(misfit)),
        100.0 * shift_m,
    )
