"""Trajectories as the text files that other programs read."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from shared.se3 import Matrix, quat_xyzw_from_rotation

_NS = 1_000_000_000
_EUROC_COLUMNS = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
Stamped = Iterable[tuple[int, Matrix]]  # (t_ns, T_world_camera [4, 4]), in order


class TrajectoryFormat(StrEnum):
    """What a trajectory can be written as; all camera to world, metres."""

    TUM = "tum"  # seconds, position, quaternion xyzw
    KITTI = "kitti"  # the first three rows of the matrix; no stamps
    CSV = "csv"  # EuRoC: nanoseconds, position, quaternion wxyz, with names of the columns


def trajectory_text(poses: Stamped, format: TrajectoryFormat) -> str:
    """The file's text, one line a pose."""
    lines = [_EUROC_COLUMNS] if format is TrajectoryFormat.CSV else []
    lines += [_LINES[format](t_ns, T) for t_ns, T in poses]
    return "".join(line + "\n" for line in lines)


def _tum(t_ns: int, T: Matrix) -> str:
    return " ".join([f"{t_ns // _NS}.{t_ns % _NS:09d}", *_numbers(*T[:3, 3], *_xyzw(T))])


def _kitti(t_ns: int, T: Matrix) -> str:
    return " ".join(_numbers(*T[:3].ravel()))


def _euroc(t_ns: int, T: Matrix) -> str:
    x, y, z, w = _xyzw(T)
    return ",".join([str(t_ns), *_numbers(*T[:3, 3], w, x, y, z)])


def _xyzw(T: Matrix) -> tuple[float, float, float, float]:
    return quat_xyzw_from_rotation(T[:3, :3])


def _numbers(*values: float) -> list[str]:
    return [f"{float(value):.9f}" for value in values]


_LINES = {
    TrajectoryFormat.TUM: _tum,
    TrajectoryFormat.KITTI: _kitti,
    TrajectoryFormat.CSV: _euroc,
}
