"""One map over many frames: does it grow, does it slow down?

python -m benchmarks.mapping_endurance SEQUENCE [--frames N] [--iterations N] [--json FILE]

The mapper, in this process, is fed a sequence to and fro with its true poses, then optimised
further with no frame coming. Memory is this process's resident set, time its own CPU, so that a
busy machine tells the same.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.disturbances import to_and_fro
from benchmarks.endurance import Process
from benchmarks.mapping_run import new_keyframe, true_pose
from pointslam.datasets import FileSequence, open_sequence
from services.mapping.config import MappingConfig
from services.mapping.pipeline import Mapper
from services.mapping.warm_up import warm_up
from shared.config import override, read_overrides
from shared.se3 import Matrix

EVERY = 5  # frames between keyframes
PERIOD_NS = 33_000_000


@dataclass(frozen=True)
class Span:
    """Means over the iterations of a part of the run, and the state at its end."""

    frames: int
    keyframes: int
    anchors: int
    iterations: int
    iteration_cpu_ms: float
    insert_cpu_ms: float | None  # None where no frame came
    rss_mb: float
    peak_rss_mb: float


class Endurance:
    """A mapper and what its steps cost since the last span."""

    def __init__(self, sequence: FileSequence, mapper: Mapper) -> None:
        self._sequence = sequence
        self._mapper = mapper
        self._poses: dict[int, Matrix] = {}
        self._frames = 0
        self._iteration_s: list[float] = []
        self._insert_s: list[float] = []

    def feed(self, frames: int) -> Span:
        """So many frames more."""
        for seq in range(self._frames, self._frames + frames):
            index = to_and_fro(seq, len(self._sequence))
            if seq % EVERY == 0:
                self._insert(seq, index)
            self._iterate(self._mapper.config.schedule.iterations_per_frame)
        self._frames += frames
        return self._span()

    def optimise(self, iterations: int) -> Span:
        """So many iterations with no frame coming."""
        self._iterate(iterations)
        return self._span()

    def _insert(self, seq: int, index: int) -> None:
        self._poses[seq] = true_pose(self._sequence, index)
        keyframe = new_keyframe(self._sequence, index, {index: self._poses[seq]})
        frame = dataclasses.replace(keyframe.frame, seq=seq, t_ns=seq * PERIOD_NS)
        poses = dataclasses.replace(
            keyframe.poses,
            revision=len(self._poses),
            seqs=np.array(list(self._poses), np.int64),
            T_world_keyframes=np.stack(list(self._poses.values())),
        )
        start = time.process_time()
        self._mapper.insert_keyframe(dataclasses.replace(keyframe, frame=frame, poses=poses))
        self._insert_s.append(time.process_time() - start)

    def _iterate(self, count: int) -> None:
        for _ in range(count):
            start = time.process_time()
            self._mapper.iterate()
            self._iteration_s.append(time.process_time() - start)

    def _span(self) -> Span:
        iteration_s, self._iteration_s = self._iteration_s, []
        insert_s, self._insert_s = self._insert_s, []
        return Span(
            frames=self._frames,
            keyframes=len(self._poses),
            anchors=len(self._mapper.anchors),
            iterations=self._mapper.iterations,
            iteration_cpu_ms=round(1e3 * float(np.mean(iteration_s)), 1),
            insert_cpu_ms=round(1e3 * float(np.mean(insert_s)), 1) if insert_s else None,
            rss_mb=round(Process(os.getpid()).rss_mb(), 1),
            peak_rss_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        )


def run(options: argparse.Namespace) -> list[Span]:
    """All spans; each is printed when it is done."""
    warm_up()
    sequence = open_sequence(options.sequence)
    config = override(MappingConfig(), read_overrides(None, options.set))
    endurance = Endurance(sequence, Mapper(sequence.calibration, config, 0, torch.device("cpu")))
    spans = []
    for _ in range(options.frames // options.span):
        spans.append(endurance.feed(options.span))
        print(spans[-1], flush=True)
    for _ in range(options.iterations // 1000):
        spans.append(endurance.optimise(1000))
        print(spans[-1], flush=True)
    return spans


def main(argv: list[str]) -> int:
    """Run over the folder named in argv and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--span", type=int, default=200, help="frames whose means are compared")
    parser.add_argument("--iterations", type=int, default=10_000, help="after the last frame")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    spans = run(options)
    if options.json:
        options.json.write_text(json.dumps([asdict(span) for span in spans], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
