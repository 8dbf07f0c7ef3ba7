"""Tracking alone, in process, over sequences, beside itself with less and its peers.

Times are a worker's on a map whose owner has the next neighbourhood ready: from the frame in hand
to the answer, with the waiting for what is fetched, unpacked and derived beside.

python -m benchmarks.tracking SEQUENCE... [--frames N] [--stride N] [--json FILE] [--alone]
    [--max-depth-m M] [--depth-frames N]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.tracking_run import Row, run
from benchmarks.tracking_variants import PeerRow, ablation, peers
from benchmarks.true_sequence import TrueSequence
from services.tracking.config import TrackingConfig
from shared.config import override, read_overrides
from shared.errors import PointSlamError

_HEADER = (
    "sequence / variant / peer   frames lost coarse reloc  kfs ateOnl.cm ateFin.cm  "
    "rpe1mm  rpe1d rpe30mm rpe30d   ms50   ms95  last/first"
)


def _print_row(row: Row, indent: str = "") -> None:
    print(
        f"{indent + row.sequence:27} {row.frames:6d} {row.lost:4d} {row.coarse_only:6d} "
        f"{row.relocalised:5d} {row.keyframes:4d} {row.ate_online_cm:9.3f} {row.ate_final_cm:9.3f} "
        f"{row.rpe1_mm:7.2f} {row.rpe1_deg:6.3f} {row.rpe30_mm:7.2f} {row.rpe30_deg:6.3f} "
        f"{row.total_ms_median:6.1f} {row.total_ms_p95:6.1f} {row.last_to_first:11.2f}",
        flush=True,
    )


def _print_stages(row: Row) -> None:
    stages = ", ".join(
        f"{name} {ms:.1f} ({row.stages_ms_p95[name]:.1f})"
        for name, ms in row.stages_ms_median.items()
    )
    print(f"  median (p95) ms: {stages}", flush=True)
    if (cold := row.cold_worker) is not None:
        print(
            f"  cold worker ms: build {cold.build_ms:.1f}, wire {cold.wire_ms:.1f}, "
            f"derive {cold.derive_ms:.1f}; context {cold.context_kb:.0f} kB",
            flush=True,
        )


def _print_peer(row: PeerRow) -> None:
    if row.absent:
        print(f"{'  ' + row.peer:27} absent: {row.absent}", flush=True)
        return
    print(
        f"{'  ' + row.peer:27} {row.frames:6d} {row.lost:4d} {'':30}{row.ate_cm:7.3f} "
        f"{row.rpe1_mm:7.2f} {row.rpe1_deg:6.3f} {row.rpe30_mm:7.2f} {row.rpe30_deg:6.3f} "
        f"{row.total_ms_median:6.1f} {row.total_ms_p95:6.1f}",
        flush=True,
    )


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and value != value else value


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
    parser.add_argument(
        "--max-depth-m", type=float, default=20.0, help="of a sensor that does not see farther"
    )
    parser.add_argument(
        "--depth-frames", type=float, default=np.inf, help="only the first so many have depth"
    )
    parser.add_argument("--alone", action="store_true", help="without ablation and peers")
    parser.add_argument("--json", nargs="?", const="-", help="to a file, or instead of the table")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    return parser.parse_args(argv)


def _measure(path: Path, arguments: argparse.Namespace, config: TrackingConfig) -> dict[str, Any]:
    """One sequence: a row of the table as plain values, printed unless JSON goes to the screen."""
    sequence = TrueSequence(path, arguments.max_depth_m, arguments.depth_frames)
    indices = list(range(0, len(sequence), arguments.stride))[: arguments.frames]
    row = run(sequence, path.name, indices, config)
    variants = [] if arguments.alone else ablation(sequence, indices, config)
    others = [] if arguments.alone else peers(sequence, indices)
    if arguments.json != "-":
        _print_row(row)
        _print_stages(row)
        for variant in variants:
            _print_row(variant, "  ")
        for other in others:
            _print_peer(other)
    plain = asdict(row)
    plain["ablation"] = [asdict(variant) for variant in variants]
    plain["peers"] = [asdict(other) for other in others]
    return _without_nan(plain)


def main(argv: list[str]) -> int:
    """Run over the sequences named in argv and print a table or JSON."""
    arguments = _arguments(argv)
    sequences = arguments.sequences or _default_sequences()
    if not sequences:
        print("no sequence named, and none in $POINTSLAM_DATA or ../shared/data", file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    config = override(TrackingConfig(), read_overrides(None, arguments.set))
    if arguments.json != "-":
        print(_HEADER)
    try:
        rows = [_measure(path, arguments, config) for path in sequences]
    except PointSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if arguments.json:
        text = json.dumps(rows, indent=1)
        print(text) if arguments.json == "-" else Path(arguments.json).write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
