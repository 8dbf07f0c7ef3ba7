"""The text files of TUM-style folders: stamped file lists, trajectories, association by stamps."""

from __future__ import annotations

import bisect
import json
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import FrameFiles
from shared import se3
from shared.errors import InputError, SequenceError
from shared.se3 import Matrix


@dataclass(frozen=True)
class StampedFile:
    """One line of `rgb.txt` or `depth.txt`."""

    t_ns: int
    stamp: str
    path: Path


@dataclass(frozen=True)
class StampedPose:
    """One line of a TUM trajectory."""

    t_ns: int
    stamp: str
    T_world_camera: Matrix


def parse_stamp_ns(text: str) -> int:
    """Decimal seconds as whole nanoseconds, without a float's rounding."""
    return int((Decimal(text) * 1_000_000_000).to_integral_value())


def read_file_list(path: Path) -> list[StampedFile]:
    """Lines `stamp file`, files relative to the list's folder."""
    files = []
    for number, words in _rows(path):
        if len(words) < 2:
            raise _line_error(path, number, "must be `stamp file`")
        files.append(StampedFile(_stamp(path, number, words[0]), words[0], path.parent / words[1]))
    return files


def read_trajectory(path: Path) -> list[StampedPose]:
    """Lines `stamp tx ty tz qx qy qz qw`, camera to world, ordered by stamp; [] if absent."""
    if not path.is_file():
        return []
    poses = []
    for number, words in _rows(path):
        try:
            values = [float(word) for word in words[1:8]]
            T = se3.from_quat_xyzw(values[3:], values[:3])
        except (ValueError, InputError):
            reason = "must be `stamp tx ty tz qx qy qz qw` in finite numbers"
            raise _line_error(path, number, reason) from None
        poses.append(StampedPose(_stamp(path, number, words[0]), words[0], T))
    return sorted(poses, key=lambda pose: pose.t_ns)


def read_matrices(path: Path) -> list[Matrix]:
    """4x4 matrices, row-major, one a line or spread over four lines."""
    values = [word for _, words in _rows(path) for word in words]
    try:
        matrices = np.array(values, np.float64).reshape(-1, 4, 4)
    except ValueError:
        raise SequenceError(path, f"must hold 4x4 matrices, got {len(values)} values") from None
    return list(matrices)


def read_json(path: Path) -> Any:
    """A JSON file; SequenceError when it is absent or damaged."""
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise SequenceError(path, f"cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise SequenceError(path, f"is no JSON ({error})") from None


def nearest(stamps_ns: list[int], t_ns: int, max_gap_ns: int) -> int | None:
    """Index of the stamp nearest to `t_ns` within the gap; `stamps_ns` must be sorted."""
    at = bisect.bisect_left(stamps_ns, t_ns)
    around = [i for i in (at - 1, at) if 0 <= i < len(stamps_ns)]
    best = min(around, key=lambda i: abs(stamps_ns[i] - t_ns), default=None)
    if best is None or abs(stamps_ns[best] - t_ns) > max_gap_ns:
        return None
    return best


def associate(first_ns: list[int], second_ns: list[int], max_gap_ns: int) -> list[tuple[int, int]]:
    """Pairs of indices with the nearest stamps, each index used once, closest pairs first.

    Both lists must be sorted; the pairs come in order of the first.
    """
    pairs = []
    for i, t_ns in enumerate(first_ns):
        low = bisect.bisect_left(second_ns, t_ns - max_gap_ns)
        high = bisect.bisect_right(second_ns, t_ns + max_gap_ns)
        pairs += [(abs(second_ns[j] - t_ns), i, j) for j in range(low, high)]
    used_first: set[int] = set()
    used_second: set[int] = set()
    chosen = []
    for _, i, j in sorted(pairs):
        if i not in used_first and j not in used_second:
            used_first.add(i)
            used_second.add(j)
            chosen.append((i, j))
    return sorted(chosen)


def join_lists(
    colour: list[StampedFile],
    depth: list[StampedFile],
    poses: list[StampedPose],
    max_association_s: float,
) -> tuple[FrameFiles, ...]:
    """Frames from three stamped lists; a frame takes its colour image's stamp."""
    gap_ns = round(max_association_s * 1e9)
    colour = sorted(colour, key=lambda file: file.t_ns)
    depth = sorted(depth, key=lambda file: file.t_ns)
    pose_stamps = [pose.t_ns for pose in poses]
    pairs = associate([c.t_ns for c in colour], [d.t_ns for d in depth], gap_ns)
    frames = []
    for i, j in pairs:
        at = nearest(pose_stamps, colour[i].t_ns, gap_ns)
        T = None if at is None else poses[at].T_world_camera
        frames.append(FrameFiles(colour[i].t_ns, colour[i].stamp, colour[i].path, depth[j].path, T))
    return tuple(frames)


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(path, f"cannot be read ({error})") from None
    rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(lines, 1)]
    return [(number, words) for number, words in rows if words and not words[0].startswith("#")]


def _stamp(path: Path, number: int, text: str) -> int:
    try:
        return parse_stamp_ns(text)
    except (InvalidOperation, ValueError, OverflowError):
        raise _line_error(path, number, f"{text!r} is no stamp in seconds") from None


def _line_error(path: Path, number: int, reason: str) -> SequenceError:
    return SequenceError(path, f"line {number}: {reason}")
