"""Tracking alone, in process, over sequence folders: errors against truth and times by stage.

python -m benchmarks.tracking SEQUENCE... [--frames N] [--stride N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from services.mapping.keyframes import KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.local_map import LocalMap, derive
from services.tracking.pipeline import track
from shared.camera import Calibration, Camera, Intrinsics
from shared.config import override, read_overrides
from shared.frames import (
    HAS_POSE,
    ColourEncoding,
    ColourImage,
    DepthEncoding,
    DepthImage,
    Frame,
    Prior,
    TrackingStatus,
    TrackRequest,
)
from shared.se3 import angle_rad, from_quat_xyzw, inverse
from shared.tracks import Candidates, CandidatesRequest, TrackResult

Poses = NDArray[np.float64]  # [F, 4, 4]


class Folder:
    """A sequence folder with calibration.json, associations.txt and groundtruth.txt."""

    def __init__(self, path: Path) -> None:
        self._path = path
        values = json.loads((path / "calibration.json").read_text())
        names = ("fx", "fy", "cx", "cy", "width", "height")
        camera = Camera(Intrinsics(*(values[name] for name in names)))
        self.calibration = Calibration(camera, values["depth_scale"])
        self._rows = [line.split() for line in _lines(path / "associations.txt")]
        self._truth = np.loadtxt(path / "groundtruth.txt", ndmin=2)

    def __len__(self) -> int:
        return len(self._rows)

    def frame(self, index: int) -> Frame:
        """One frame; every eighth is held out of the map, as an evaluation run does."""
        stamp, colour, _, depth = self._rows[index]
        return Frame(
            seq=index,
            t_ns=round(float(stamp) * 1e9),
            rgb=ColourImage(ColourEncoding.JPEG, (self._path / colour).read_bytes()),
            depth=DepthImage(DepthEncoding.PNG16, (self._path / depth).read_bytes()),
            may_be_keyframe=index % 8 != 4,
        )

    def true_pose(self, index: int) -> NDArray[np.float64]:
        """T_world_camera of the nearest stamp."""
        stamps = self._truth[:, 0]
        row = self._truth[np.argmin(np.abs(stamps - float(self._rows[index][0])))]
        return from_quat_xyzw(row[4:8], row[1:4])


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


class StoreSource:
    """A map in this process as tracking asks for it."""

    def __init__(self, store: KeyframeStore, config: TrackingConfig) -> None:
        self._store = store
        self._config = config
        self._key = (-1, -1)
        self._local: LocalMap | None = None

    def local_map(self, reference_seq: int) -> LocalMap:
        """The neighbourhood of a keyframe; the last one is kept."""
        key = (self._store.revision, reference_seq)
        if self._local is None or key != self._key:
            context = self._store.context(reference_seq)
            self._key, self._local = key, derive(context, self._config.registration)
        return self._local

    def loop_map(self, seq: int) -> LocalMap:
        """The neighbourhood of a keyframe, of what is near to it in the graph only."""
        return derive(self._store.loop_context(seq), self._config.registration)

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
    rpe30_mm: float
    rpe30_deg: float
    total_ms_median: float
    total_ms_p95: float
    stages_ms_median: dict[str, float] = field(default_factory=dict)


def run(folder: Folder, name: str, indices: list[int], config: TrackingConfig) -> Row:
    """Track the frames in order, as the gateway and the map's owner would let it happen."""
    store = KeyframeStore()
    source = StoreSource(store, config)
    prior: Prior | None = None
    results: list[TrackResult] = []
    with ThreadPoolExecutor(1) as helper:  # as a worker has
        for index in indices:
            request = _request(folder, index, prior, store.revision)
            result = track(request, source, config, helper)
            if result.keyframe is not None:
                store.insert(index, result.t_ns, result.T_world_camera, result.keyframe)
            prior = next_prior(prior, result, store)
            results.append(result)
    truth = np.stack([folder.true_pose(index) for index in indices])
    return _row(name, results, truth, store)


def _request(folder: Folder, index: int, prior: Prior | None, revision: int) -> TrackRequest:
    return TrackRequest(
        session="benchmark",
        epoch=1,
        map_revision=revision,
        calibration=folder.calibration,
        frame=folder.frame(index),
        prior=prior,
        T_world_first=np.eye(4),
    )


def next_prior(prior: Prior | None, result: TrackResult, store: KeyframeStore) -> Prior | None:
    """What the gateway remembers after a frame."""
    if result.status not in HAS_POSE:
        if prior is None:
            return None
        return Prior(**{**prior.__dict__, "lost_frames": prior.lost_frames + 1})
    T = store.pose(result.reference_seq) @ result.T_reference_camera
    is_keyframe = result.keyframe is not None
    return Prior(
        seq=result.seq,
        t_ns=result.t_ns,
        T_world_camera=T,
        T_before_last=np.eye(4) if result.T_last_camera is None else result.T_last_camera,
        before_last_dt_ns=result.t_ns - prior.t_ns if prior else 0,
        reference_seq=result.reference_seq,
        newest_keyframe_seq=store.seqs()[-1],
        lost_frames=0,
        frames_since_keyframe=0 if is_keyframe or not prior else prior.frames_since_keyframe + 1,
    )


def _row(name: str, results: list[TrackResult], truth: Poses, store: KeyframeStore) -> Row:
    has_pose = np.array([result.status in HAS_POSE for result in results])
    found = [result for result in results if result.status in HAS_POSE]
    online = np.stack([result.T_world_camera for result in found])
    final = np.stack([store.pose(r.reference_seq) @ r.T_reference_camera for r in found])
    truth = truth[has_pose]
    rpe30 = _relative_errors(final, truth, 30)
    totals = [result.timings_ms["total"] for result in results]
    names = sorted({stage for result in results for stage in result.timings_ms})
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
        rpe1_mm=1e3 * _relative_errors(final, truth, 1)[0],
        rpe30_mm=1e3 * rpe30[0],
        rpe30_deg=rpe30[1],
        total_ms_median=float(np.median(totals)),
        total_ms_p95=float(np.percentile(totals, 95)),
        stages_ms_median={
            stage: float(np.median([r.timings_ms[stage] for r in results if stage in r.timings_ms]))
            for stage in names
        },
    )


def absolute_error(poses: Poses, truth: Poses) -> float:
    """ATE: root mean square distance after rigid alignment without scale (Umeyama), metres."""
    a, b = poses[:, :3, 3], truth[:, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    aligned = (a - a.mean(0)) @ rotation.T + b.mean(0)
    return float(np.sqrt(np.square(aligned - b).sum(axis=1).mean()))


def _relative_errors(poses: Poses, truth: Poses, gap: int) -> tuple[float, float]:
    """RPE over a gap of frames: root mean squares in metres and degrees; NaN if too short."""
    if len(poses) <= gap:
        return float("nan"), float("nan")
    steps = inverse(poses[:-gap]) @ poses[gap:]
    true_steps = inverse(truth[:-gap]) @ truth[gap:]
    errors = inverse(true_steps) @ steps
    angles = [np.degrees(angle_rad(error)) for error in errors]
    distances = np.square(errors[:, :3, 3]).sum(axis=1)
    return float(np.sqrt(distances.mean())), float(np.sqrt(np.square(angles).mean()))


_HEADER = (
    "sequence        frames lost coarse reloc  kfs ateOnl.cm ateFin.cm rpe1mm rpe30mm rpe30d "
    "  ms50   ms95"
)


def _print_row(row: Row) -> None:
    print(
        f"{row.sequence:16} {row.frames:5d} {row.lost:4d} {row.coarse_only:6d} "
        f"{row.relocalised:5d} {row.keyframes:4d} {row.ate_online_cm:9.3f} {row.ate_final_cm:8.3f} "
        f"{row.rpe1_mm:6.2f} {row.rpe30_mm:7.2f} {row.rpe30_deg:6.3f} "
        f"{row.total_ms_median:6.1f} {row.total_ms_p95:6.1f}",
        flush=True,
    )
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in row.stages_ms_median.items())
    print(f"    median ms: {stages}", flush=True)


def _without_nan(row: Row) -> dict[str, object]:
    return {k: None if isinstance(v, float) and v != v else v for k, v in asdict(row).items()}


def _default_sequences() -> list[Path]:
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    data = Path(os.environ.get("POINTSLAM_DATA", beside))
    return sorted(path.parent for path in data.glob("*/associations.txt"))


def _arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="*", type=Path)
    parser.add_argument("--frames", type=int, help="at most so many")
    parser.add_argument("--stride", type=int, default=1, help="use every so many")
    parser.add_argument("--json", nargs="?", const="-", help="to a file, or instead of the table")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Run over the folders named in argv and print a table or JSON."""
    arguments = _arguments(argv)
    sequences = arguments.sequences or _default_sequences()
    if not sequences:
        print("no sequence named, and none in $POINTSLAM_DATA or ../shared/data", file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    config = override(TrackingConfig(), read_overrides(None, arguments.set))
    as_table = arguments.json != "-"
    if as_table:
        print(_HEADER)
    rows = []
    for path in sequences:
        folder = Folder(path)
        indices = list(range(0, len(folder), arguments.stride))[: arguments.frames]
        rows.append(run(folder, path.name, indices, config))
        if as_table:
            _print_row(rows[-1])
    if arguments.json:
        text = json.dumps([_without_nan(row) for row in rows], indent=1)
        print(text) if arguments.json == "-" else Path(arguments.json).write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
