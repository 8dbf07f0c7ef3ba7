"""Trajectories as JSON and as TUM files."""

from __future__ import annotations

from typing import Any

from services.gateway.session import Session
from shared import codec
from shared.frames import HAS_POSE
from shared.maps import Trajectory, TrajectoryRequest
from shared.se3 import Pose, quat_xyzw_from_rotation

_FLUSH_S = 10.0
_NS = 1_000_000_000


async def fetch_trajectory(session: Session) -> Trajectory:
    """All answered frames, after the map's owner has those under way too."""
    await session.flush(_FLUSH_S)
    owner = session.owner
    return await owner.ask("trajectory", TrajectoryRequest(), Trajectory, 60.0)


def trajectory_json(trajectory: Trajectory) -> dict[str, Any]:
    """Records as plain JSON values."""
    keyframes = {int(seq) for seq in trajectory.keyframe_seqs}
    finals = trajectory.T_world_cameras_final
    return {
        "records": [
            {
                "seq": record.seq,
                "t_ns": record.t_ns,
                "status": str(record.status),
                "keyframe": record.seq in keyframes,
                "reference_seq": record.reference_seq,
                "T_map_camera_online": codec.to_json(Pose.from_matrix(record.T_world_camera)),
                "T_map_camera_final": codec.to_json(Pose.from_matrix(T_final)),
            }
            for record, T_final in zip(trajectory.records, finals, strict=True)
        ]
    }


def trajectory_tum(trajectory: Trajectory, kind: str) -> str:
    """Lines of a TUM file; `kind` is online (as told) or final (as the map is now)."""
    lines = []
    for record, T_final in zip(trajectory.records, trajectory.T_world_cameras_final, strict=True):
        if record.status in HAS_POSE:
            T = record.T_world_camera if kind == "online" else T_final
            numbers = [*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])]
            stamp = f"{record.t_ns // _NS}.{record.t_ns % _NS:09d}"
            lines.append(" ".join([stamp, *(f"{float(n):.9f}" for n in numbers)]))
    return "".join(line + "\n" for line in lines)
