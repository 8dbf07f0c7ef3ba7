"""Which keyframes were tracked from which: the graph that drift runs along.

An edge joins a keyframe with the one it was tracked from, with those whose landmarks it saw, and,
once a place was recognised, with the earlier keyframe of that place. Its length is how much the
view changes, so a long way through the graph between two keyframes of one place means drift.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from shared.se3 import angle_rad, inverse
from shared.tracks import KEYPOINT_BITS

Matrix = NDArray[np.float64]


@dataclass(frozen=True, order=True)
class Way:
    """How far it is from one keyframe to another along the graph."""

    views: float = 0.0  # change of view: metres over the depth of the scene, plus radians
    metres: float = 0.0
    radians: float = 0.0

    def __add__(self, other: Way) -> Way:
        return Way(
            self.views + other.views, self.metres + other.metres, self.radians + other.radians
        )


class EdgeKind(IntEnum):
    """What told the relative pose of two keyframes."""

    TRACKED = 0
    JOINED = 1  # a place seen again without drift
    LOOP = 2  # a place seen again, its drift closed


@dataclass(frozen=True)
class Edge:
    """A measured relative pose of two keyframes, `first` the older one."""

    first: int
    second: int
    T_first_second: Matrix  # [4, 4]
    information: Matrix  # [6, 6], of a twist on the right of it
    kind: EdgeKind
    depth_m: float  # median of the scene as the second one saw it

    @property
    def way(self) -> Way:
        """Its length: nothing where a place was seen again, since nothing drifts along it."""
        if self.kind is not EdgeKind.TRACKED:
            return Way()
        metres = float(np.linalg.norm(self.T_first_second[:3, 3]))
        radians = angle_rad(self.T_first_second)
        return Way(metres / self.depth_m + radians, metres, radians)


class KeyframeGraph:
    """Edges between keyframes. Loops keep what was measured; the others follow the adjustment."""

    def __init__(self) -> None:
        self._edges: dict[tuple[int, int], Edge] = {}
        self._ways: dict[int, dict[int, Way]] = {}

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def edges(self) -> list[Edge]:
        """All edges, in order of insertion."""
        return list(self._edges.values())

    @property
    def num_loops(self) -> int:
        """Edges of recognised places."""
        return sum(edge.kind is EdgeKind.LOOP for edge in self._edges.values())

    def copy(self) -> KeyframeGraph:
        """The same edges in another graph."""
        graph = KeyframeGraph()
        for edge in self.edges:
            graph.add(edge)
        return graph

    def add(self, edge: Edge) -> None:
        """Add an edge, or replace that of the same two keyframes."""
        self._edges[edge.first, edge.second] = edge
        way = edge.way
        self._ways.setdefault(edge.first, {})[edge.second] = way
        self._ways.setdefault(edge.second, {})[edge.first] = way

    def follow(self, moved: Iterable[int], poses: Mapping[int, Matrix]) -> None:
        """Take the relative poses of keyframes that the bundle adjustment moved as measured anew.

        Args:
            moved: their seqs.
            poses: present T_world_camera of all keyframes.
        """
        for a in moved:
            for b in list(self._ways.get(a, ())):
                edge = self._edges[min(a, b), max(a, b)]
                if edge.kind is not EdgeKind.LOOP:
                    T = inverse(poses[edge.first]) @ poses[edge.second]
                    self.add(replace(edge, T_first_second=T))

    def ways_from(self, seq: int, limit_views: float = np.inf) -> dict[int, Way]:
        """Keyframes within a limit and the shortest way to each, nearest first (Dijkstra)."""
        done: dict[int, Way] = {}
        queue: list[tuple[float, int, Way]] = [(0.0, seq, Way())]
        while queue:
            _, at, way = heapq.heappop(queue)
            if at in done:
                continue
            done[at] = way
            for neighbour, step in self._ways.get(at, {}).items():
                there = way + step
                if neighbour not in done and there.views <= limit_views:
                    heapq.heappush(queue, (there.views, neighbour, there))
        return done

    def state(self) -> dict[str, np.ndarray]:
        """All edges as arrays, for a snapshot."""
        edges = self.edges
        return {
            "graph.pairs": np.array([(e.first, e.second) for e in edges], np.int64).reshape(-1, 2),
            "graph.T_first_second": _stacked([e.T_first_second for e in edges], 4),
            "graph.information": _stacked([e.information for e in edges], 6),
            "graph.kinds": np.array([e.kind for e in edges], np.uint8),
            "graph.depths_m": np.array([e.depth_m for e in edges], np.float64),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take up a `state()`."""
        for n, (first, second) in enumerate(state["graph.pairs"].tolist()):
            self.add(
                Edge(
                    first=first,
                    second=second,
                    T_first_second=state["graph.T_first_second"][n],
                    information=state["graph.information"][n],
                    kind=EdgeKind(int(state["graph.kinds"][n])),
                    depth_m=float(state["graph.depths_m"][n]),
                )
            )


def linked_keyframes(
    landmark_ids: NDArray[np.int64], own_seq: int, min_shared: int, limit: int
) -> list[int]:
    """Seqs of the keyframes that founded most of the landmarks a keyframe saw, most first."""
    founders, counts = np.unique(
        landmark_ids[landmark_ids >= 0] >> KEYPOINT_BITS, return_counts=True
    )
    order = np.argsort(-counts, kind="stable")
    keep = [i for i in order if counts[i] >= min_shared and founders[i] != own_seq]
    return [int(founders[i]) for i in keep[:limit]]


def _stacked(matrices: list[Matrix], size: int) -> Matrix:
    return np.array(matrices, np.float64).reshape(-1, size, size)
