"""A run's or a session's map and trajectory as files."""

from __future__ import annotations

import shutil
from pathlib import Path

from pointslam.client import Client, Session
from pointslam.datasets.lists import read_trajectory
from pointslam.run import open_saved_session
from pointslam.run_folder import RunFolder
from shared.maps import SUFFIXES, ExportFormat
from shared.trajectories import TrajectoryFormat, trajectory_text


def export_source(
    source: str, format: ExportFormat | TrajectoryFormat, gateway: str, out: Path | None
) -> Path:
    """Write the map or the trajectory of a run's folder, or of a session that a gateway serves.

    Returns:
        the file: `out`, or one named after the source in the working folder.

    Raises:
        PointSlamError: there is no such run or session, or it cannot be exported.
    """
    folder = RunFolder(Path(source))
    name = Path(source).resolve().name if folder.is_run() else source
    target = out or Path(f"{name}{_suffix(format)}")
    if not folder.is_run():
        with Client(gateway) as client:
            _write(client.session(source), format, target)
    elif isinstance(format, TrajectoryFormat):
        _convert(folder.trajectory("final"), format, target)
    else:
        with open_saved_session(folder, folder.read_record()) as session:
            _write(session, format, target)
    return target


def _suffix(format: ExportFormat | TrajectoryFormat) -> str:
    if isinstance(format, ExportFormat):
        return f".{SUFFIXES[format]}"
    return ".txt" if format is TrajectoryFormat.TUM else f".{format}"


def _convert(tum: Path, format: TrajectoryFormat, target: Path) -> None:
    """Write a run's trajectory; as TUM with the stamps as the sequence spells them."""
    if format is TrajectoryFormat.TUM:
        shutil.copyfile(tum, target)
        return
    poses = [(pose.t_ns, pose.T_world_camera) for pose in read_trajectory(tum)]
    target.write_text(trajectory_text(poses, format))


def _write(session: Session, format: ExportFormat | TrajectoryFormat, target: Path) -> None:
    if isinstance(format, ExportFormat):
        session.export(format, target)
    else:
        target.write_text(trajectory_text(session.poses("final"), format))
