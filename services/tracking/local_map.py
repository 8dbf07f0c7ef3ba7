"""The neighbourhood that a frame is tracked in: a context with what is derived from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from services.tracking.carried import SeenFeatures
from services.tracking.config import RegistrationConfig
from services.tracking.voxel_map import VoxelMap, build_voxel_map
from shared.free_space import FreeSpace, seen_through
from shared.se3 import inverse
from shared.tracks import Candidates, CandidatesRequest, TrackingContext


@dataclass(frozen=True)
class LocalMap:
    """A context and the voxels of its cloud."""

    context: TrackingContext
    voxels: VoxelMap

    @cached_property
    def free_space(self) -> FreeSpace:
        """What the reference keyframe sees through, to the map."""
        T_reference_world = inverse(self.context.T_world_reference)
        return seen_through(self.context.cloud_world.points, T_reference_world)

    @cached_property
    def seen(self) -> SeenFeatures:
        """What the window's keyframes saw."""
        return SeenFeatures.of(self.context.window, only_moving=False)

    @cached_property
    def seen_moving(self) -> SeenFeatures:
        """What of it is known to move."""
        return SeenFeatures.of(self.context.window, only_moving=True)


class MapSource(Protocol):
    """Where tracking asks for the map. The same question has the same answer in one revision."""

    def local_map(self, reference_seq: int) -> LocalMap:
        """The neighbourhood of a keyframe; of the newest one for -1."""
        ...

    def loop_map(self, seq: int) -> LocalMap | None:
        """The neighbourhood of a keyframe, of what is near to it in the graph only.

        None where it cannot be had in time.
        """
        ...

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """Keyframes that look like a frame."""
        ...


def derive(context: TrackingContext, config: RegistrationConfig) -> LocalMap:
    """Build what registration needs of a context."""
    return LocalMap(context, build_voxel_map(context.cloud_world, config.voxel_sizes_m))
