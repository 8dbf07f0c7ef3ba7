"""Tracking alone, in process, over a sequence: errors against truth, times by stage."""

from __future__ import annotations

from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.cold_worker import ColdWorker, cold_worker
from benchmarks.true_sequence import TrueSequence
from services.gateway.prior import next_prior
from services.mapping.keyframes.store import KeyframeConfig, KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.executors import NoHelper
from services.tracking.local_map import LocalMap
from services.tracking.pipeline import track
from shared import codec
from shared.frames import HAS_POSE, Prior, TrackingStatus, TrackRequest
from shared.se3 import angle_rad, inverse
from shared.tracks import Candidates, CandidatesRequest, TrackingContext, TrackResult

Poses = NDArray[np.float64]  # [F, 4, 4]
_Key = tuple[int, int, bool]  # revision, seq of the reference, near only
_SPAN = 100  # frames whose times are compared


class StoreSource:
    """A map in this process as a worker has it: unpacked and derived while a frame is decoded."""

    def __init__(
        self, store: KeyframeStore, config: TrackingConfig, fetching: Executor | None = None
    ) -> None:
        self._store = store
        self._config = config
        self._fetching = fetching or NoHelper()
        self._built: dict[_Key, bytes] = {}
        self._fetched: dict[_Key, Future[LocalMap]] = {}

    def build_ahead(self, seq: int) -> None:
        """What the map's owner does as soon as it knows where the next frame starts."""
        self._forget_older()
        if self._key(seq, False) in self._fetched or self._key(seq, False) in self._built:
            return
        context = self._store.context(seq)
        self._built[self._key(seq, False)] = codec.pack(context)
        for loop_seq in context.loop_seqs.tolist():
            self._built[self._key(loop_seq, True)] = codec.pack(self._store.loop_context(loop_seq))

    def fetch_ahead(self, reference_seq: int) -> None:
        """What a worker does as soon as it has a frame, for it and for its next keyframe."""
        self._fetch(reference_seq, False)
        for _, seq, is_near_only in list(self._built):
            self._fetch(seq, is_near_only)

    def _forget_older(self) -> None:
        for kept in (self._built, self._fetched):
            for key in [key for key in kept if key[0] != self._store.revision]:
                del kept[key]

    def _key(self, seq: int, is_near_only: bool) -> _Key:
        return self._store.revision, seq, is_near_only

    def _fetch(self, seq: int, is_near_only: bool) -> Future[LocalMap]:
        self._forget_older()
        key = self._key(seq, is_near_only)
        if key not in self._fetched:
            self._fetched[key] = self._fetching.submit(self._receive, key, self._built.get(key))
        return self._fetched[key]

    def _receive(self, key: _Key, built: bytes | None) -> LocalMap:
        if built is None:
            _, seq, is_near_only = key
            ask = self._store.loop_context if is_near_only else self._store.context
            built = codec.pack(ask(seq))
        local = LocalMap(codec.unpack(TrackingContext, built), self._config.registration)
        return local if key[2] else local.built()

    def local_map(self, reference_seq: int) -> LocalMap:
        """The neighbourhood of a keyframe."""
        return self._fetch(reference_seq, False).result()

    def loop_map(self, seq: int) -> LocalMap:
        """The neighbourhood of a keyframe, of what is near to it in the graph only."""
        return self._fetch(seq, True).result()

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """Keyframes that look like a frame."""
        return self._store.candidates(request)


@dataclass(frozen=True)
class Row:
    """Figures of one sequence."""

    sequence: str
    frames: int
    lost: int
    coarse_only: int
    relocalised: int
    keyframes: int
    ate_online_cm: float
    ate_final_cm: float
    rpe1_mm: float
    rpe1_deg: float
    rpe30_mm: float
    rpe30_deg: float
    total_ms_median: float
    total_ms_p95: float
    last_to_first: float  # median time of the last hundred frames beside that of the first
    stages_ms_median: dict[str, float] = field(default_factory=dict)
    stages_ms_p95: dict[str, float] = field(default_factory=dict)
    cold_worker: ColdWorker | None = None


@dataclass(frozen=True)
class Tracked:
    """Results of a sequence's frames, and the map that they made."""

    results: list[TrackResult]
    store: KeyframeStore

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """Which frames have a pose, [F]."""
        return np.array([result.status in HAS_POSE for result in self.results])

    def final_poses(self) -> Poses:
        """T_world_camera of the frames that have one, as the map corrected them at last."""
        found = [result for result in self.results if result.status in HAS_POSE]
        return np.stack([self.store.pose(r.reference_seq) @ r.T_reference_camera for r in found])


def run(
    sequence: TrueSequence,
    name: str,
    indices: list[int],
    config: TrackingConfig,
    keyframes: KeyframeConfig | None = None,
) -> Row:
    """Track the frames in order, as `track_all` does, beside the truth."""
    tracked = track_all(sequence, indices, config, keyframes)
    truth = np.stack([sequence.true_pose(index) for index in indices])
    return _row(name, tracked, truth, config)


def track_all(
    sequence: TrueSequence,
    indices: list[int],
    config: TrackingConfig,
    keyframes: KeyframeConfig | None = None,
) -> Tracked:
    """Track the frames in order, as the gateway and the map's owner would let it happen."""
    store = KeyframeStore(keyframes)
    prior: Prior | None = None
    results: list[TrackResult] = []
    with ThreadPoolExecutor(1) as helper, ThreadPoolExecutor(1) as fetching:  # as a worker has
        source = StoreSource(store, config, fetching)
        for index in indices:
            request = _request(sequence, index, prior, store.revision)
            source.fetch_ahead(prior.reference_seq if prior else -1)
            result = track(request, source, config, helper)
            if result.keyframe is not None:
                store.insert(index, result.t_ns, result.T_world_camera, result.keyframe)
            prior = next_prior(prior, request.frame, result)
            if prior is not None:
                source.build_ahead(prior.reference_seq)
            results.append(result)
    return Tracked(results, store)


def _request(
    sequence: TrueSequence, index: int, prior: Prior | None, revision: int
) -> TrackRequest:
    return TrackRequest(
        session="benchmark",
        epoch=1,
        map_revision=revision,
        calibration=sequence.calibration,
        frame=sequence.frame(index),
        prior=prior,
        T_world_first=np.eye(4),
    )


def _row(name: str, tracked: Tracked, truth: Poses, config: TrackingConfig) -> Row:
    results, store, has_pose = tracked.results, tracked.store, tracked.has_pose
    online = np.stack([r.T_world_camera for r in results if r.status in HAS_POSE])
    final, truth = tracked.final_poses(), truth[has_pose]
    rpe1, rpe30 = relative_errors(final, truth, 1), relative_errors(final, truth, 30)
    totals = [result.timings_ms["total"] for result in results]
    names = sorted({stage for result in results for stage in result.timings_ms})
    stages = {n: [r.timings_ms[n] for r in results if n in r.timings_ms] for n in names}
    counted = [result.status for result in results]
    return Row(
        sequence=name,
        frames=len(results),
        lost=int((~has_pose).sum()),
        coarse_only=counted.count(TrackingStatus.COARSE_ONLY),
        relocalised=counted.count(TrackingStatus.RELOCALISED),
        keyframes=len(store),
        ate_online_cm=100 * absolute_error(online, truth),
        ate_final_cm=100 * absolute_error(final, truth),
        rpe1_mm=1e3 * rpe1[0],
        rpe1_deg=rpe1[1],
        rpe30_mm=1e3 * rpe30[0],
        rpe30_deg=rpe30[1],
        total_ms_median=float(np.median(totals)),
        total_ms_p95=float(np.percentile(totals, 95)),
        last_to_first=float(np.median(totals[-_SPAN:]) / np.median(totals[:_SPAN])),
        stages_ms_median={name: float(np.median(times)) for name, times in stages.items()},
        stages_ms_p95={name: float(np.percentile(times, 95)) for name, times in stages.items()},
        cold_worker=cold_worker(store, config),
    )


def absolute_error(poses: Poses, truth: Poses) -> float:
    """ATE: root mean square distance after rigid alignment without scale (Umeyama), metres.

    NaN for fewer than three poses with truth: anything can be aligned to these.
    """
    is_known = np.isfinite(truth[:, 0, 0])
    if is_known.sum() < 3:
        return float("nan")
    a, b = poses[is_known, :3, 3], truth[is_known, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    aligned = (a - a.mean(0)) @ rotation.T + b.mean(0)
    return float(np.sqrt(np.square(aligned - b).sum(axis=1).mean()))


def relative_errors(poses: Poses, truth: Poses, gap: int) -> tuple[float, float]:
    """RPE over a gap of frames: root mean squares in metres and degrees; NaN if too short."""
    is_known = np.isfinite(truth[:, 0, 0])
    from_rows = np.flatnonzero(is_known[:-gap] & is_known[gap:])
    if len(from_rows) == 0:
        return float("nan"), float("nan")
    steps = inverse(poses[from_rows]) @ poses[from_rows + gap]
    true_steps = inverse(truth[from_rows]) @ truth[from_rows + gap]
    errors = inverse(true_steps) @ steps
    angles = [np.degrees(angle_rad(error)) for error in errors]
    distances = np.square(errors[:, :3, 3]).sum(axis=1)
    return float(np.sqrt(distances.mean())), float(np.sqrt(np.square(angles).mean()))
