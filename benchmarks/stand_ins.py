"""Participants on the real bus that answer with plain values: a tracker that takes a given time, a
mapper that keeps records in memory. They let the gateway be measured and tested by itself.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from benchmarks.empty_keyframe import empty_keyframe
from benchmarks.stand_in_answers import Place, export_piece, located, serve_pins
from shared import se3
from shared.bus import Bus, Keys
from shared.errors import ClaimLostError, ConflictError, NotFoundError
from shared.frames import HAS_POSE, TrackingStatus, TrackRequest
from shared.georeference import GeoreferenceRequest
from shared.images import decode_colour, decode_depth
from shared.localization import LocalizeRequest, LocalizeResult
from shared.maps import (
    DeleteRequest,
    Empty,
    ExportRequest,
    JobState,
    JobStatus,
    KeyframeReply,
    KeyframeRequest,
    MapInfo,
    RefineRequest,
    RenderReply,
    RenderRequest,
    SaveReply,
    SaveRequest,
    SessionList,
    SessionSummary,
    Trajectory,
    TrajectoryRequest,
)
from shared.tracks import (
    Advance,
    Advanced,
    AdvanceReply,
    ClaimReply,
    ClaimRequest,
    KeyframePoses,
    OpenReply,
    OpenRequest,
    TrackResult,
)

STEP_M = 0.01  # the camera moves so far along x from one frame number to the next
KEYFRAME_EVERY = 10
_CONCURRENT_FRAMES = 2  # of one tracker, as of a real one


class StandInTracker:
    """Answers each frame with a pose that its number tells: after `delay_s`, if it `may_answer`."""

    def __init__(self, bus: Bus, name: str) -> None:
        self.name = name
        self.delay_s = 0.0
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.status = TrackingStatus.TRACKED
        self.decodes = False
        self.requests: list[TrackRequest] = []
        self.leave = bus.close
        self.images: list[LocalizeRequest] = []
        self._executor = ThreadPoolExecutor(_CONCURRENT_FRAMES, thread_name_prefix=name)
        bus.serve(Keys.track(name), TrackRequest, self.answer, self._executor)
        bus.serve(Keys.localize(name), LocalizeRequest, self.localize)
        bus.declare_alive("tracking", name)

    def answer(self, request: TrackRequest) -> TrackResult:
        """The answer to one frame."""
        self.requests.append(request)
        del self.requests[:-100]
        if self.decodes:
            decode_colour(request.frame.rgb, request.calibration.colour.intrinsics)
            decode_depth(request.frame.depth, request.calibration)
        time.sleep(self.delay_s)
        self.may_answer.wait()
        frame, prior = request.frame, request.prior
        reference = prior.newest_keyframe_seq if prior else frame.seq
        is_due = prior is None or frame.seq - reference >= KEYFRAME_EVERY
        is_keyframe = is_due and frame.may_be_keyframe and self.status in HAS_POSE
        T_world_camera = request.T_world_first @ se3.exp([STEP_M * frame.seq, 0, 0, 0, 0, 0])
        T_world_reference = request.T_world_first @ se3.exp([STEP_M * reference, 0, 0, 0, 0, 0])
        return TrackResult(
            seq=frame.seq,
            t_ns=frame.t_ns,
            status=self.status,
            T_world_camera=T_world_camera,
            covariance=1e-6 * np.eye(6),
            reference_seq=reference,
            T_reference_camera=se3.inverse(T_world_reference) @ T_world_camera,
            inliers=100,
            inlier_share=0.5,
            map_revision=request.map_revision,
            timings_ms={"decode": 1.0},
            keyframe=empty_keyframe() if is_keyframe else None,
        )

    def localize(self, request: LocalizeRequest) -> LocalizeResult:
        """Where the prior says; without one it is not found."""
        self.images.append(request)
        del self.images[:-100]
        time.sleep(self.delay_s)
        self.may_answer.wait()
        return located(request)


@dataclass
class _Map:
    request: OpenRequest
    epoch: int
    claim: int = 0
    entries: list[Advance] = field(default_factory=list)
    refinement: JobStatus = field(default_factory=JobStatus)
    place: Place = field(default_factory=Place)
    stops: list = field(default_factory=list)

    def keyframes(self) -> list[Advance]:
        return [entry for entry in self.entries if entry.keyframe is not None]

    def poses(self) -> KeyframePoses:
        keyframes = self.keyframes()
        poses = [entry.record.T_world_camera for entry in keyframes]
        return KeyframePoses(
            revision=len(keyframes),
            seqs=np.array([entry.record.seq for entry in keyframes], np.int64),
            T_world_keyframes=np.array(poses).reshape(-1, 4, 4),
        )


class StandInMapper:
    """Keeps the entries of its sessions in `disk`, which another mapper may share."""

    def __init__(self, bus: Bus, name: str, disk: dict[str, _Map] | None = None) -> None:
        self.name = name
        self.disk: dict[str, _Map] = {} if disk is None else disk
        self._bus = bus
        self._lock = threading.Lock()
        self.opened: list[str] = []
        self.was_asked = threading.Event()  # what sessions it has: somebody knows of it
        self.may_answer = threading.Event()  # that it has opened a session
        self.may_answer.set()
        self.leave = bus.close
        bus.serve(Keys.mapper(name, "open"), OpenRequest, self.open)
        bus.serve(Keys.mapper(name, "list"), Empty, self.list)
        bus.serve(Keys.mapper(name, "delete"), DeleteRequest, self.delete)
        serve_pins(bus, name)
        bus.declare_alive("mapping", name)

    def open(self, request: OpenRequest) -> OpenReply:
        """Create a session, or own one that exists in a new epoch."""
        with self._lock:
            known = self.disk.get(request.session)
            if request.calibration is None and known is None:
                raise NotFoundError(f"no session {request.session}")
            if request.calibration is not None and known is not None:
                raise ConflictError(f"session {request.session} exists")
            known = known or _Map(request, 0)
            known.epoch += 1
            self.disk[request.session] = known
            self._serve(request.session, known)
        self.opened.append(request.session)
        self.may_answer.wait()
        return self._opening(request.session, known)

    def _opening(self, session: str, known: _Map) -> OpenReply:
        assert known.request.calibration is not None
        return OpenReply(
            session=session,
            mapper=self.name,
            epoch=known.epoch,
            mode=known.request.mode,
            map_revision=len(known.keyframes()),
            created_ns=time.time_ns(),
            calibration=known.request.calibration,
            T_world_first=known.request.T_world_first,
            last=known.entries[-1].record if known.entries else None,
            keyframe_poses=known.poses(),
            prior=known.entries[-1].prior if known.entries else None,
        )

    def _claim(self, session: str, known: _Map, request: ClaimRequest) -> ClaimReply:
        if 0 < request.held == known.claim:
            return ClaimReply(known.claim, None)
        known.claim += 1
        self._bus.publish(Keys.advanced(session), Advanced(known.claim, len(known.keyframes())))
        return ClaimReply(known.claim, self._opening(session, known))

    def _advance(self, session: str, known: _Map, entry: Advance) -> AdvanceReply:
        if entry.claim < known.claim:
            raise ClaimLostError(f"claim {known.claim} is newer")
        if not known.entries or entry.record.seq > known.entries[-1].record.seq:
            known.entries.append(entry)
            news = Advanced(known.claim, len(known.keyframes()), entry.record)
            self._bus.publish(Keys.advanced(session), news)
        return AdvanceReply(known.entries[-1].record.seq, len(known.keyframes()))

    def list(self, _: Empty) -> SessionList:
        """All sessions."""
        self.was_asked.set()
        rows = [
            SessionSummary(name, 0, known.request.mode, len(known.keyframes()), True)
            for name, known in self.disk.items()
        ]
        return SessionList(tuple(rows))

    def delete(self, request: DeleteRequest) -> Empty:
        """Forget a session."""
        if request.session not in self.disk:
            raise NotFoundError(f"no session {request.session}")
        for stop in self.disk.pop(request.session).stops:
            stop()
        return Empty()

    def _serve(self, session: str, known: _Map) -> None:
        answers = {
            "claim": (ClaimRequest, lambda request: self._claim(session, known, request)),
            "advance": (Advance, lambda entry: self._advance(session, known, entry)),
            "keyframes": (Empty, lambda _: known.poses()),
            "render": (RenderRequest, lambda request: _render(known, request)),
            "keyframe": (KeyframeRequest, lambda request: _keyframe_image(known, request)),
            "export": (ExportRequest, export_piece),
            "refine": (RefineRequest, lambda request: _refine(known, request)),
            "refinement": (Empty, lambda _: known.refinement),
            "interrupt": (Empty, lambda _: known.refinement),
            "save": (SaveRequest, lambda _: SaveReply(len(known.keyframes()), 1000)),
            "info": (Empty, lambda _: self._info(session, known)),
            "georeference": (GeoreferenceRequest, known.place.answer),
            "trajectory": (TrajectoryRequest, lambda _: _trajectory(known)),
        }
        known.stops = [
            self._bus.serve(Keys.session(session, known.epoch, question), kind, answer)
            for question, (kind, answer) in answers.items()
        ]

    def _info(self, session: str, known: _Map) -> MapInfo:
        return MapInfo(
            session=session,
            mapper=self.name,
            epoch=known.epoch,
            mode=known.request.mode,
            map_revision=len(known.keyframes()),
            frames=len(known.entries),
            keyframes=len(known.keyframes()),
            landmarks=0,
            primary_anchors=0,
            secondary_anchors=0,
            iterations=known.refinement.iterations_done,
            pending=0,
            psnr_db=None,
            refinement=known.refinement,
            stages_ms={},
            iteration_ms=None,
            mapping_s=0.0,
            refinement_s=0.0,
            map_bytes=0,
            device="cpu",
            loops=1,
        )


def _render(known: _Map, request: RenderRequest) -> RenderReply:
    size = (request.intrinsics.height, request.intrinsics.width)
    rgb = np.full((*size, 3), 128, np.uint8)
    opaque, known_half = np.full(size, 255, np.uint8), np.full(size, 128, np.uint8)
    state = f"{known.epoch}.{len(known.keyframes())}.{known.refinement.iterations_done}"
    if request.unless_state == state:
        rgb, opaque, known_half = rgb[:0], opaque[:0], known_half[:0]
    depth_m = np.full(opaque.shape, 1.5, np.float32)
    return RenderReply(len(known.keyframes()), rgb, depth_m, opaque, known_half, state)


def _keyframe_image(known: _Map, request: KeyframeRequest) -> KeyframeReply:
    found = {entry.record.seq: entry for entry in known.keyframes()}.get(request.seq)
    if found is None or found.frame is None:
        raise NotFoundError(f"no keyframe {request.seq}")
    return KeyframeReply(request.seq, found.record.t_ns, np.eye(4), found.frame.rgb)


def _refine(known: _Map, request: RefineRequest) -> JobStatus:
    known.refinement = JobStatus(JobState.DONE, request.iterations, request.iterations, 30.0, job=1)
    return JobStatus(JobState.RUNNING, 0, request.iterations, job=1)


def _trajectory(known: _Map) -> Trajectory:
    records = tuple(entry.record for entry in known.entries)
    finals = np.array([record.T_world_camera for record in records]).reshape(-1, 4, 4)
    return Trajectory(records, finals, known.poses().seqs)
