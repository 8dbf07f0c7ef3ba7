"""Beside the tracker: itself with parts taken away, and the peers that this Python has."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.peers.registry import PEERS, PeerEntry
from benchmarks.tracking_run import Row, absolute_error, relative_errors, run
from benchmarks.true_sequence import TrueSequence
from services.mapping.keyframes.loop_config import LoopConfig
from services.mapping.keyframes.store import KeyframeConfig
from services.tracking.config import TrackingConfig
from shared.config import override, read_overrides
from shared.rectify import rectify

# None of them closes loops: the whole tracker is what the settings say.
ABLATION: dict[str, tuple[str, ...]] = {
    "coarse only": (
        "orb.max_hamming_bits=0",
        "orb.max_hamming_bits_global=0",
        "keyframe.min_landmark_share=0",
        "bundle_adjustment.iterations=0",
    ),
    "+ ORB": ("bundle_adjustment.iterations=0",),
    "+ bundle adjustment": (),
}
_NO_LOOPS = KeyframeConfig(loop=LoopConfig(is_enabled=False))


@dataclass(frozen=True)
class PeerRow:
    """A peer's figures; where its library is absent, that and nothing else."""

    peer: str
    absent: str = ""
    frames: int = 0
    lost: int = 0  # as the peer itself says
    ate_cm: float = float("nan")
    rpe1_mm: float = float("nan")
    rpe1_deg: float = float("nan")
    rpe30_mm: float = float("nan")
    rpe30_deg: float = float("nan")
    total_ms_median: float = float("nan")
    total_ms_p95: float = float("nan")


def ablation(sequence: TrueSequence, indices: list[int], config: TrackingConfig) -> list[Row]:
    """The tracker with parts taken away, on the same frames; `sequence` names the variant."""
    rows = []
    for name, settings in ABLATION.items():
        changed = override(config, read_overrides(None, list(settings)))
        rows.append(replace(run(sequence, name, indices, changed, _NO_LOOPS), cold_worker=None))
    return rows


def peers(sequence: TrueSequence, indices: list[int]) -> list[PeerRow]:
    """Every peer on the same frames, one after the other; absent ones are said to be absent."""
    return [_peer_row(entry, sequence, indices) for entry in PEERS]


def _peer_row(entry: PeerEntry, sequence: TrueSequence, indices: list[int]) -> PeerRow:
    if importlib.util.find_spec(entry.library) is None:
        return PeerRow(entry.name, absent=f"{entry.library} is not installed")
    peer = entry.make()
    poses, times, tracked = [], [], 0
    for index in indices:
        image = rectify(sequence.frame(index), sequence.calibration)
        start = time.perf_counter()
        pose = peer.track(image)
        times.append(1e3 * (time.perf_counter() - start))
        poses.append(pose.T_world_camera)
        tracked += pose.is_tracked
    found, truth = np.stack(poses), np.stack([sequence.true_pose(index) for index in indices])
    rpe1, rpe30 = relative_errors(found, truth, 1), relative_errors(found, truth, 30)
    return PeerRow(
        peer=entry.name,
        frames=len(indices),
        lost=len(indices) - tracked,
        ate_cm=100 * absolute_error(found, truth),
        rpe1_mm=1e3 * rpe1[0],
        rpe1_deg=rpe1[1],
        rpe30_mm=1e3 * rpe30[0],
        rpe30_deg=rpe30[1],
        total_ms_median=float(np.median(times)),
        total_ms_p95=float(np.percentile(times, 95)),
    )
