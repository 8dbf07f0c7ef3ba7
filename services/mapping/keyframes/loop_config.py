"""The numbers of loop closing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.graph import Way
from services.mapping.keyframes.loop_candidates import LoopCandidatesConfig
from services.mapping.keyframes.pose_graph import PoseGraphConfig
from shared.errors import ConfigError
from shared.se3 import angle_rad

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Bound:
    """A limit on a distance and on an angle: a floor, and a share of the way."""

    floor_m: float
    floor_deg: float
    share: float = 0.0

    def metres(self, way: Way) -> float:
        """The distance after such a way."""
        return self.floor_m + self.share * way.metres

    def radians(self, way: Way) -> float:
        """The angle after such a way."""
        return math.radians(self.floor_deg) + self.share * way.radians

    def holds(self, T: Matrix, way: Way) -> bool:
        """Whether a difference stays within it."""
        is_near = float(np.linalg.norm(T[:3, 3])) <= self.metres(way)
        return is_near and angle_rad(T) <= self.radians(way)


@dataclass(frozen=True)
class LoopConfig:
    """How loops are found, judged and closed."""

    is_enabled: bool = True  # off: nothing is looked for and nothing is closed
    near_views: float = 2.5  # keyframes within this way along the graph have no drift between them
    min_shared: int = 15  # landmarks, for an edge with the keyframe that founded them
    max_links: int = 4  # edges of that kind for each keyframe
    candidates: LoopCandidatesConfig = field(default_factory=LoopCandidatesConfig)
    graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    # Within the first bound there is no drift to speak of: contexts join the two passes as they
    # are. Beyond the second one it is not believed at all (places that look alike), within the
    # third one at once, between them when another keyframe says the same.
    unmoved: Bound = field(default_factory=lambda: Bound(0.02, 0.6))
    possible: Bound = field(default_factory=lambda: Bound(0.20, 6.0, 0.05))
    expected: Bound = field(default_factory=lambda: Bound(0.03, 1.0, 0.005))
    agreement: Bound = field(default_factory=lambda: Bound(0.05, 2.0))
    remainder: Bound = field(default_factory=lambda: Bound(0.05, 2.0))  # of a loop once closed
    # One sigma: of the drift along an edge beside what registration says, and of a loop.
    drift_sigma: Bound = field(default_factory=lambda: Bound(0.003, 0.03, 0.005))
    loop_sigma: Bound = field(default_factory=lambda: Bound(0.005, 0.15))

    def __post_init__(self) -> None:
        if self.near_views <= 0:
            raise ConfigError(f"loop.near_views must be positive, got {self.near_views}")
