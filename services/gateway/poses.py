"""The last poses of a session: the newest, and between stamps by interpolation."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared import se3
from shared.errors import NotFoundError
from shared.frame_rows import ROW, STATUSES, read_row, write_row
from shared.frames import HAS_POSE, TrackingStatus
from shared.tracks import FrameRecord, KeyframePoses, TrackResult

_HAS_POSE = np.array([status in HAS_POSE for status in STATUSES])


def record_of(result: TrackResult) -> FrameRecord:
    """What the map's owner and the pose ring keep of an answer."""
    return FrameRecord(
        seq=result.seq,
        t_ns=result.t_ns,
        status=result.status,
        reference_seq=result.reference_seq,
        T_reference_camera=result.T_reference_camera,
        T_world_camera=result.T_world_camera,
        covariance=result.covariance,
    )


def deviations(covariance: NDArray[np.float64]) -> tuple[float, float] | None:
    """One standard deviation of position (metres) and rotation (degrees); None if unknown."""
    position, rotation = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    if not (np.isfinite(position) and np.isfinite(rotation)) or min(position, rotation) < 0:
        return None
    return float(np.sqrt(position)), float(np.degrees(np.sqrt(rotation)))


@dataclass(frozen=True)
class TimedPose:
    """The camera at one time, in the map as it is now."""

    seq: int
    t_ns: int
    status: TrackingStatus
    T_map_camera: NDArray[np.float64]  # [4, 4]
    covariance: NDArray[np.float64]  # [6, 6]
    reference_seq: int
    map_revision: int
    is_interpolated: bool = False

    def deviations(self) -> tuple[float, float] | None:
        """Of position (metres) and rotation (degrees); None where the camera was lost."""
        return deviations(self.covariance) if self.status in HAS_POSE else None


class PoseRing:
    """The last `size` answered frames of a session, by time."""

    def __init__(self, size: int, max_gap_s: float) -> None:
        self._rows = np.empty(size, ROW)
        self._revisions = np.empty(size, np.int64)  # of the map that each was answered in
        self._count = 0  # ever added
        self._max_gap_ns = int(max_gap_s * 1e9)

    def add(self, record: FrameRecord, map_revision: int) -> None:
        """Add the newest answer and the revision of the map it was made against."""
        at = self._count % len(self._rows)
        write_row(self._rows, at, record)
        self._revisions[at] = map_revision
        self._count += 1

    def clear(self) -> None:
        """Forget all."""
        self._count = 0

    def last(self, keyframes: KeyframePoses) -> TimedPose:
        """The newest answered frame; a LOST one has the last known pose.

        Raises:
            NotFoundError: no frame has been answered.
        """
        if self._count == 0:
            raise NotFoundError("no frame of this session has a pose yet")
        return self._pose((self._count - 1) % len(self._rows), keyframes)

    def at(self, t_ns: int, keyframes: KeyframePoses) -> TimedPose:
        """The pose at a time, between the two frames around it.

        Raises:
            NotFoundError: the time is outside what is kept, or there the camera was lost.
        """
        places = self._places_with_pose()
        times_ns = self._rows["t_ns"][places]
        after = int(np.searchsorted(times_ns, t_ns))
        if after < len(places) and times_ns[after] == t_ns:
            return self._pose(places[after], keyframes)
        if not 0 < after < len(places):
            raise NotFoundError(f"no pose at {t_ns}: {_span(times_ns)}")
        a, b = (self._pose(place, keyframes) for place in places[after - 1 : after + 1])
        if b.t_ns - a.t_ns > self._max_gap_ns:
            raise NotFoundError(f"no pose at {t_ns}: none from {a.t_ns} to {b.t_ns}")
        return _between(a, b, t_ns)

    def _places_with_pose(self) -> NDArray[np.int64]:
        """Rows of frames that have a pose, by time."""
        size = len(self._rows)
        places = np.arange(max(0, self._count - size), self._count) % size
        return places[_HAS_POSE[self._rows["status"][places]]]

    def _pose(self, place: int, keyframes: KeyframePoses) -> TimedPose:
        record, revision = read_row(self._rows[place]), int(self._revisions[place])
        return _corrected(record, revision, keyframes)


def _span(times_ns: NDArray[np.int64]) -> str:
    if len(times_ns) == 0:
        return "no frame of this session has a pose"
    return f"poses are kept from {times_ns[0]} to {times_ns[-1]}"


def _corrected(record: FrameRecord, revision: int, keyframes: KeyframePoses) -> TimedPose:
    """The pose moved along with its reference keyframe, if the map changed since it was told."""
    T, now = record.T_world_camera, revision
    if keyframes.revision > revision:
        at = np.flatnonzero(keyframes.seqs == record.reference_seq)
        if at.size:
            T = keyframes.T_world_keyframes[at[0]] @ record.T_reference_camera
            now = keyframes.revision
    return TimedPose(
        seq=record.seq,
        t_ns=record.t_ns,
        status=record.status,
        T_map_camera=T,
        covariance=record.covariance,
        reference_seq=record.reference_seq,
        map_revision=now,
    )


def _between(a: TimedPose, b: TimedPose, t_ns: int) -> TimedPose:
    fraction = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    nearer = a if fraction < 0.5 else b
    return dataclasses.replace(
        nearer,
        t_ns=t_ns,
        T_map_camera=se3.interpolate(a.T_map_camera, b.T_map_camera, fraction),
        is_interpolated=True,
    )
