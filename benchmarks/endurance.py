"""One tracking worker over many frames: does it grow, does it slow down?

python -m benchmarks.endurance SEQUENCE [--frames N] [--json FILE]

A worker process tracks a sequence to and fro; the map is in this process. Memory is the worker's
resident set, time its own CPU, so that a busy machine tells the same.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.disturbances import to_and_fro
from benchmarks.true_sequence import TrueSequence
from pointslam.process import DEFAULT_ENVIRONMENT
from services.gateway.prior import next_prior
from services.mapping.keyframes.contexts import Contexts
from services.mapping.keyframes.store import KeyframeStore
from shared.bus import Bus, Keys, open_bus, open_router
from shared.frames import Prior, TrackRequest
from shared.tracks import (
    Candidates,
    CandidatesRequest,
    ContextRequest,
    KeyframeData,
    TrackingContext,
    TrackResult,
)

_SESSION = "endurance"
_PERIOD_NS = 33_000_000
_SPAN = 100  # frames whose times are compared
_PATIENCE_S = 120.0  # memory and CPU are measured: a machine with other work may take its time


@dataclass(frozen=True)
class Row:
    """Figures of one run; CPU is per frame, all threads of the worker together."""

    sequence: str
    frames: int
    keyframes: int
    rss_mb_at: dict[int, float]  # by the number of frames
    cpu_ms_by_span: list[float]  # mean of every hundred frames


@dataclass(frozen=True)
class Process:
    """What the kernel knows of a process (Linux)."""

    pid: int

    def cpu_s(self) -> float:
        """User and system time of all threads."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def rss_mb(self) -> float:
        """Resident memory."""
        pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@contextmanager
def worker(endpoint: str) -> Iterator[Process]:
    """A worker process that is ready, started as `pointslam` starts its own."""
    command = [sys.executable, "-m", "services.tracking", "--connect", endpoint, "--id", _SESSION]
    command += ["--set", f"query_timeout_s={_PATIENCE_S}"]
    environment = DEFAULT_ENVIRONMENT | os.environ
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            yield Process(process.pid)
        finally:  # else an error here would wait for the worker, which waits for requests
            process.terminate()


def run(sequence: TrueSequence, name: str, frames: int) -> Row:
    """Track so many frames of a sequence."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    router = open_router(endpoint)
    try:
        with open_bus([endpoint]) as bus, worker(endpoint) as process:
            return _measure(bus, process, sequence, name, frames)
    finally:
        router.close()


def _measure(bus: Bus, process: Process, sequence: TrueSequence, name: str, frames: int) -> Row:
    served = _Map(bus)
    prior: Prior | None = None
    cpu_s, rss_mb = [], {}
    for seq in range(frames):
        before_s = process.cpu_s()
        prior = _track(bus, sequence, served, seq, prior)
        cpu_s.append(process.cpu_s() - before_s)
        if (seq + 1) % (5 * _SPAN) == 0 or seq + 1 in (_SPAN, frames):
            rss_mb[seq + 1] = round(process.rss_mb(), 1)
    spans = np.array(cpu_s[: frames // _SPAN * _SPAN]).reshape(-1, _SPAN)
    per_frame = (1e3 * spans.mean(axis=1)).round(1).tolist()
    return Row(name, frames, served.num_keyframes, rss_mb, per_frame)


class _Map:
    """A map that is asked and told one thing at a time, as its owner sees to."""

    def __init__(self, bus: Bus) -> None:
        self._store = KeyframeStore()
        self._contexts = Contexts(self._store)
        self._lock = threading.Lock()
        bus.serve(Keys.session(_SESSION, 1, "context"), ContextRequest, self._context)
        bus.serve(Keys.session(_SESSION, 1, "candidates"), CandidatesRequest, self._candidates)

    @property
    def revision(self) -> int:
        return self._store.revision

    @property
    def num_keyframes(self) -> int:
        return len(self._store)

    def insert(self, result: TrackResult, keyframe: KeyframeData) -> None:
        with self._lock:
            self._store.insert(result.seq, result.t_ns, result.T_world_camera, keyframe)

    def _context(self, request: ContextRequest) -> TrackingContext:
        with self._lock:
            return self._contexts.get(request)

    def _candidates(self, request: CandidatesRequest) -> Candidates:
        with self._lock:
            return self._store.candidates(request)


def _track(
    bus: Bus, sequence: TrueSequence, served: _Map, seq: int, prior: Prior | None
) -> Prior | None:
    frame = sequence.frame(to_and_fro(seq, len(sequence)))
    frame = dataclasses.replace(frame, seq=seq, t_ns=seq * _PERIOD_NS)
    revision, calibration = served.revision, sequence.calibration
    request = TrackRequest(_SESSION, 1, revision, calibration, frame, prior, np.eye(4))
    result = bus.query(Keys.track(_SESSION), request, TrackResult, _PATIENCE_S)
    if result.keyframe is not None:
        served.insert(result, result.keyframe)
    return next_prior(prior, frame, result)


def main(argv: list[str]) -> int:
    """Run over the sequence named in argv and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(argv)
    row = run(TrueSequence(arguments.sequence), arguments.sequence.name, arguments.frames)
    print(row)
    if arguments.json:
        arguments.json.write_text(json.dumps(asdict(row), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
