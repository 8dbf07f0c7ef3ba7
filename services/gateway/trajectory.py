"""Trajectories as JSON and as files."""

from __future__ import annotations

from typing import Any

from services.gateway.session import Session
from shared import codec
from shared.frames import HAS_POSE
from shared.maps import Trajectory, TrajectoryRequest
from shared.se3 import Pose
from shared.trajectories import TrajectoryFormat, trajectory_text

_FLUSH_S = 10.0


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


def trajectory_file(trajectory: Trajectory, format: TrajectoryFormat, kind: str) -> str:
    """All frames with a pose; `kind` is online (as told) or final (as the map is now)."""
    finals = trajectory.T_world_cameras_final
    poses = [
        (record.t_ns, record.T_world_camera if kind == "online" else T_final)
        for record, T_final in zip(trajectory.records, finals, strict=True)
        if record.status in HAS_POSE
    ]
    return trajectory_text(poses, format)


def path_json(trajectory: Trajectory, max_points: int) -> dict[str, Any]:
    """Runs of positions of the final poses, metres; a run ends where the camera was lost."""
    step = -(-len(trajectory.records) // max_points)
    runs: list[list[list[float]]] = [[]]
    for i, (record, T) in enumerate(
        zip(trajectory.records, trajectory.T_world_cameras_final, strict=True)
    ):
        if record.status not in HAS_POSE:
            runs.append([])
        elif i % max(step, 1) == 0:
            runs[-1].append([round(float(c), 4) for c in T[:3, 3]])
    last = trajectory.records[-1].seq if trajectory.records else -1
    return {"last_seq": last, "runs": [run for run in runs if run]}
