"""What a session knows apart from its Gaussians: the log, the answered frames, the keyframes."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes.contexts import Contexts
from services.mapping.keyframes.store import KeyframeConfig, KeyframeStore
from services.mapping.map_state import MapState
from services.mapping.metrics import LOG_SECONDS
from services.mapping.pipeline import NewKeyframe
from services.mapping.storage.entries import check_entry
from services.mapping.storage.folders import SessionFolder, SessionRecord
from services.mapping.storage.frame_records import FrameRecords
from services.mapping.storage.log import SessionLog, read_log
from services.mapping.storage.snapshot import read_newest
from services.mapping.views.pose_offsets import Offsets
from shared.errors import ConflictError
from shared.frames import Frame, Prior
from shared.maps import JobStatus, Trajectory
from shared.tracks import (
    Advance,
    Candidates,
    CandidatesRequest,
    ContextRequest,
    FrameRecord,
    KeyframePoses,
    TrackingContext,
)


@dataclass(frozen=True)
class Capture:
    """The ledger's part of a snapshot."""

    entries: int
    keyframes: dict[str, np.ndarray]


@dataclass(frozen=True)
class Resumed:
    """What the map must take up: a snapshot, and the entries behind it."""

    map: MapState | None = None
    refinement: JobStatus = JobStatus()
    frames: dict[int, Frame] = field(default_factory=dict)  # keyframes of the snapshot
    moving: dict[int, NDArray[np.bool_]] = field(default_factory=dict)  # their `moving_cells`
    later: list[NewKeyframe | None] = field(default_factory=list)

    def note(self, entry: Advance) -> None:
        """Keep the images of an entry that the snapshot's map has."""
        if entry.frame is not None and entry.keyframe is not None:
            self.frames[entry.frame.seq] = entry.frame
            if entry.keyframe.moving_cells is not None:
                self.moving[entry.frame.seq] = entry.keyframe.moving_cells


class Ledger:
    """Log, records and keyframe store, always in step with each other; safe from any thread."""

    def __init__(
        self, folder: SessionFolder, record: SessionRecord, config: KeyframeConfig
    ) -> None:
        self._lock = threading.Lock()
        self._records = FrameRecords()
        self.prior: Prior | None = None  # what the next frame starts from
        self._store = KeyframeStore(config)
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="context")
        self.resumed = self._resume(folder, record.log_ends, config)
        self._contexts = Contexts(self._store)
        self._log = SessionLog(folder.log_path(record.epoch))

    def _resume(
        self, folder: SessionFolder, log_ends: dict[str, int], config: KeyframeConfig
    ) -> Resumed:
        """Read the newest snapshot and every older epoch's log."""
        snapshot = read_newest(folder.path)
        resumed = Resumed()
        if snapshot:
            resumed = Resumed(snapshot.map, snapshot.refinement)
            self._store = KeyframeStore.from_state(snapshot.keyframes, config)
        for name in sorted(log_ends):
            for entry in read_log(folder.path / name, log_ends[name]):
                if snapshot and len(self._records) < snapshot.entries:
                    self._note(entry)
                    resumed.note(entry)
                else:
                    resumed.later.append(self._apply(entry))
        return resumed

    def forget_resumed(self) -> None:
        """Let go of what the map has taken up."""
        self.resumed = Resumed()

    @property
    def entries(self) -> int:
        """Number of answered frames."""
        return len(self._records)

    @property
    def last(self) -> FrameRecord | None:
        """The newest answered frame."""
        return self._records.last

    @property
    def revision(self) -> int:
        """Grows with every keyframe and correction."""
        return self._store.revision

    @property
    def num_landmarks(self) -> int:
        """ORB points of the map."""
        return self._store.num_landmarks()

    @property
    def num_loops(self) -> int:
        """Places that were seen again and joined."""
        return self._store.num_loops

    @property
    def num_keyframes(self) -> int:
        """Keyframes of the map."""
        return len(self._store)

    def holds(self, seq: int) -> bool:
        """Whether a frame was appended before: the sender did not hear the acknowledgement."""
        return seq in self._records

    def append(self, entry: Advance) -> NewKeyframe | None:
        """Log an entry and insert its keyframe; returns what the map must be told.

        Raises:
            InputError: frame and keyframe data do not belong together, or cannot be applied.
            ConflictError: the frame is older than the newest one.
            StorageError: the disk refused; nothing has changed.
        """
        check_entry(entry)
        with self._lock:
            last, record, reference_seq = self.last, entry.record, self._reference_seq
            if last is not None and record.seq <= last.seq:
                raise ConflictError(f"frame {record.seq} is not newer than {last.seq}")
            with LOG_SECONDS.time():
                self._log.append(entry)
            new = self._apply(entry)
            next_seq = self._reference_seq
        if new is not None or next_seq != reference_seq:
            self._ahead.submit(self._build_ahead, next_seq)
        return new

    @property
    def _reference_seq(self) -> int:
        """The keyframe whose neighbourhood the next frame is tracked in; -1: the newest one."""
        return self.prior.reference_seq if self.prior else -1

    def _build_ahead(self, seq: int) -> None:
        """What the next frames ask for is there when they come."""
        context = self.context(ContextRequest(self.revision, seq))
        for loop_seq in context.loop_seqs.tolist():
            self.context(ContextRequest(context.revision, loop_seq, is_near_only=True))

    def _apply(self, entry: Advance) -> NewKeyframe | None:
        record = entry.record
        self._note(entry)
        if entry.frame is None or entry.keyframe is None:
            return None
        self._store.insert(record.seq, record.t_ns, record.T_world_camera, entry.keyframe)
        _, landmarks_world = self._store.landmarks_seen_by(record.seq)
        moving_cells = entry.keyframe.moving_cells
        return NewKeyframe(entry.frame, self._store.poses(), landmarks_world, moving_cells)

    def _note(self, entry: Advance) -> None:
        self._records.append(entry.record)
        self.prior = entry.prior

    def poses(self) -> KeyframePoses:
        """Present poses of all keyframes."""
        with self._lock:
            return self._store.poses()

    def pose(self, seq: int) -> NDArray[np.float64]:
        """Present pose of a keyframe, T_world_camera, [4, 4].

        Raises:
            NotFoundError: no such keyframe.
        """
        with self._lock:
            return self._store.pose(seq)

    def context(self, request: ContextRequest) -> TrackingContext:
        """The neighbourhood of a keyframe.

        Raises:
            NotFoundError: no such keyframe, where only what is near to it is asked for.
        """
        with self._lock:
            return self._contexts.get(request)

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """Keyframes that look like a frame."""
        with self._lock:
            return self._store.candidates(request)

    def trajectory(self, offsets: Offsets) -> Trajectory:
        """All answered frames, with the corrections and offsets of their keyframes applied."""
        with self._lock:
            records = self._records.all()
            poses = self._store.poses()
        T_world_keyframe = dict(zip(poses.seqs.tolist(), poses.T_world_keyframes, strict=True))
        T_world_keyframe |= {seq: T_world_keyframe[seq] @ T for seq, T in offsets.items()}
        final = [_final_pose(record, T_world_keyframe) for record in records]
        return Trajectory(records, np.array(final).reshape(-1, 4, 4), poses.seqs)

    def capture(self) -> Capture:
        """The store and the place in the log, which is made durable up to there."""
        with self._lock:
            self._log.sync()
            return Capture(self.entries, self._store.state())

    def close(self) -> None:
        """Close the log."""
        self._ahead.shutdown()
        self._log.close()


def _final_pose(record: FrameRecord, T_world_keyframe: dict[int, np.ndarray]) -> np.ndarray:
    if record.seq in T_world_keyframe:
        return T_world_keyframe[record.seq]
    if record.reference_seq in T_world_keyframe:
        return T_world_keyframe[record.reference_seq] @ record.T_reference_camera
    return record.T_world_camera
