"""What a client is told of its frame."""

from __future__ import annotations

from services.gateway.poses import deviations
from shared.frames import HAS_POSE
from shared.se3 import Pose
from shared.stream import FrameReply
from shared.tracks import TrackResult


def reply_of(result: TrackResult, times_ms: dict[str, float]) -> FrameReply:
    """A worker's answer for the client, with the gateway's times beside the worker's."""
    deviation = deviations(result.covariance) if result.status in HAS_POSE else None
    return FrameReply(
        seq=result.seq,
        t_ns=result.t_ns,
        status=result.status,
        T_map_camera=Pose.from_matrix(result.T_world_camera),
        pos_std_m=deviation[0] if deviation else None,
        rot_std_deg=deviation[1] if deviation else None,
        inliers=result.inliers,
        inlier_share=result.inlier_share,
        reference_seq=result.reference_seq,
        map_revision=result.map_revision,
        keyframe=result.keyframe is not None,
        timings_ms=result.timings_ms | times_ms,
    )
