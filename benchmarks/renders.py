"""Renders while the map is optimised: how long a request waits, and what it costs the optimisation.

python -m benchmarks.renders [SEQUENCE] [--frames N] [--seconds S] [--http] [--json]

One session in this process, its worker refining all the time; one client asks for novel views
(no two alike, so that none comes from the cache), then for one view again and again. Then a
snapshot is captured. With --http, a client asks all services, as processes of their own, instead.
Without a sequence, a procedural room is recorded first.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.mapping_run import new_keyframe, true_pose
from benchmarks.renders_http import asked, measure_http, spread
from pointslam.datasets import FileSequence, open_sequence
from pointslam.synth import SynthOptions, write_sequence
from services.mapping.config import MappingConfig
from services.mapping.pipeline import Mapper
from services.mapping.sessions.renders import Renders
from services.mapping.sessions.worker import OFFLINE, MapWorker
from services.mapping.storage.refinement import Refinement
from services.mapping.warm_up import warm_up
from shared import se3
from shared.errors import PointSlamError
from shared.maps import JobStatus, RenderRequest

EVERY = 5  # frames between keyframes
OFF_PATH = (0.05, 0.05, 0.05, 0.1, 0.1, 0.1)  # of a view: standard deviations, metres and radians


def arguments(argv: list[str]) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path, nargs="?")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each part")
    parser.add_argument("--http", action="store_true", help="through a gateway")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(argv)


def built_map(sequence: FileSequence, frames: int) -> tuple[Mapper, list[NDArray[np.float64]]]:
    """A map of the first frames, and the poses of its keyframes."""
    mapper = Mapper(sequence.calibration, MappingConfig(), 0, torch.device("cpu"))
    poses: dict[int, NDArray[np.float64]] = {}
    for index in range(0, min(frames, len(sequence)), EVERY):
        poses[index] = true_pose(sequence, index)
        mapper.insert_keyframe(new_keyframe(sequence, index, poses))
        mapper.iterate(2)
    return mapper, list(poses.values())


def iterations_per_s(worker: MapWorker, seconds: float) -> float:
    """Speed of the optimisation when nobody asks."""
    before = worker.iterations
    time.sleep(seconds)
    return (worker.iterations - before) / seconds


def measure(sequence: FileSequence, options: argparse.Namespace) -> dict[str, Any]:
    """All parts, one after the other."""
    mapper, poses = built_map(sequence, options.frames)
    rng, camera = np.random.default_rng(0), mapper.sightings.camera
    views = [
        RenderRequest(poses[i % len(poses)] @ se3.exp(rng.normal(0, OFF_PATH)), camera)
        for i in range(1000)
    ]
    renders = Renders(mapper, 1, mapper.config.render)
    with tempfile.TemporaryDirectory() as folder:
        refinement = Refinement(Path(folder), JobStatus())
        worker = MapWorker(mapper, refinement, OFFLINE, mapper.config)
        worker.start()
        worker.refine(1_000_000)
        result: dict[str, Any] = {"anchors": len(mapper.anchors)}
        result["iterations_per_s_alone"] = iterations_per_s(worker, options.seconds)
        before = worker.iterations
        result |= spread(
            "new_view", asked(lambda i: renders.answer(views[i % 1000]), options.seconds)
        )
        result["iterations_per_s_rendering"] = (worker.iterations - before) / options.seconds
        result |= spread(
            "same_view", asked(lambda _: renders.answer(views[0]), options.seconds / 2)
        )
        result["snapshot_pause_ms"] = snapshot_pause_ms(worker)
        worker.interrupt()
        worker.stop()
    return result


def snapshot_pause_ms(worker: MapWorker) -> float:
    """How long the optimisation rests while its state is copied."""

    def copied(mapper: Mapper, room: dict[str, torch.Tensor]) -> float:
        start = time.perf_counter()
        mapper.state(room)
        return 1e3 * (time.perf_counter() - start)

    rooms = [worker.room() for _ in range(3)]
    return float(np.median([worker.visit(lambda m, room=room: copied(m, room)) for room in rooms]))


def main(argv: list[str]) -> int:
    """Print the measurements."""
    options = arguments(argv)
    try:
        if not options.http:
            warm_up()
        with tempfile.TemporaryDirectory() as folder:
            if options.sequence is None:
                options.sequence = Path(folder) / "room"
                write_sequence(options.sequence, SynthOptions(num_frames=options.frames))
            sequence = open_sequence(options.sequence)
            if options.http:
                result = measure_http(sequence, options.frames, options.seconds)
            else:
                result = measure(sequence, options)
    except PointSlamError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if options.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:28} {value:10.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
