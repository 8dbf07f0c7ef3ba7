"""The neighbourhood that a frame is tracked in: a context with what is derived from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from services.tracking.config import RegistrationConfig
from services.tracking.voxel_map import VoxelMap, build_voxel_map
from shared.tracks import Candidates, CandidatesRequest, TrackingContext


@dataclass(frozen=True)
class LocalMap:
    """A context and the voxels of its cloud."""

    context: TrackingContext
    voxels: VoxelMap


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
