"""A run's or a session's map and trajectory as files."""

from __future__ import annotations

import shutil
from pathlib import Path

from pointslam.client import Client, Session
from pointslam.run import open_saved_session
from pointslam.run_folder import RunFolder, tum_lines

_SUFFIXES = {"ply": ".ply", "mesh": "-mesh.ply", "tum": ".txt"}


def export_source(source: str, format: str, gateway: str, out: Path | None) -> Path:
    """Write the map of a run's folder, or of a session that a gateway serves; returns the file.

    Raises:
        PointSlamError: there is no such run or session, or it cannot be exported.
    """
    folder = RunFolder(Path(source))
    target = out or Path(f"{Path(source).name}{_SUFFIXES[format]}")
    if not folder.is_run():
        with Client(gateway) as client:
            _write(client.session(source), format, target)
    elif format == "tum":
        shutil.copyfile(folder.trajectory("final"), target)
    else:
        with open_saved_session(folder, folder.read_record()) as session:
            _write(session, format, target)
    return target


def _write(session: Session, format: str, target: Path) -> None:
    if format != "tum":
        session.export(format, target)
        return
    poses = session.poses("final")
    stamps = [f"{t_ns // 10**9}.{t_ns % 10**9:09d}" for t_ns, _ in poses]
    target.write_text(tum_lines(stamps, [T for _, T in poses]))
