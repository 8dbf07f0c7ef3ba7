"""The neighbourhood that a frame is tracked in: a context with what is derived from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from services.tracking.carried import SeenFeatures
from services.tracking.config import RegistrationConfig
from services.tracking.voxel_map import VoxelLevel, VoxelMap, build_voxel_map
from shared.free_space import FreeSpace, seen_through
from shared.se3 import inverse
from shared.tracks import Candidates, CandidatesRequest, PointCloud, TrackingContext

_GLANCE_STEP = 4  # of the coarsest voxels, which many points share


@dataclass(frozen=True)
class LocalMap:
    """A context and what follows from it, built when it is first asked for."""

    context: TrackingContext
    config: RegistrationConfig

    def built(self) -> LocalMap:
        """Itself, with all that a frame needs of it built now."""
        _ = self.voxels, self.seen, self.seen_moving, self.free_space
        return self

    @cached_property
    def voxels(self) -> VoxelMap:
        """What a frame is registered to."""
        return build_voxel_map(self.context.cloud_world, self.config.voxel_sizes_m)

    @cached_property
    def glance(self) -> VoxelLevel:
        """The coarsest voxels, of a part of the points: a tenth of the work of `voxels`."""
        cloud = self.context.cloud_world
        part = PointCloud(
            np.ascontiguousarray(cloud.points[::_GLANCE_STEP]),
            np.ascontiguousarray(cloud.normals[::_GLANCE_STEP]),
        )
        return build_voxel_map(part, self.config.voxel_sizes_m[:1]).levels[0]

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
    """A context with all that a frame needs of it."""
    return LocalMap(context, config).built()
