"""Renders as a client sees them: through the gateway and the bus, while the map is optimised."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pointslam.client import Client, Session
from pointslam.datasets import FileSequence
from pointslam.launcher import LaunchOptions, Services
from pointslam.streaming import StreamOptions, stream_sequence
from shared import se3

_OFF_PATH = (0.05, 0.05, 0.05, 0.1, 0.1, 0.1)  # of a view: standard deviations, metres and radians
_ENDLESS = 1_000_000  # iterations


def measure_http(sequence: FileSequence, frames: int, seconds: float) -> dict[str, Any]:
    """All services as processes; one client asks for novel views while a refinement runs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = LaunchOptions(folder / "data", folder / "logs", num_trackers=1)
        with Services(options) as services, Client(services.url) as client:
            session = client.create_session(sequence.calibration, mode="offline")
            stream_sequence(session, sequence, StreamOptions(frames, 0, False))
            session.wait_until_mapped()
            session.start_refinement(_ENDLESS)
            return _refined_and_rendered(session, seconds)


def _refined_and_rendered(session: Session, seconds: float) -> dict[str, Any]:
    views = novel_views(session)
    before = session.info()["iterations"]
    times_ms = asked(lambda i: session.render(views[i % len(views)]), seconds)
    done = session.info()["iterations"] - before
    return spread("http_new_view", times_ms) | {"http_iterations_per_s": done / seconds}


def novel_views(session: Session) -> list[NDArray[np.float64]]:
    """Poses off the camera's path, no two alike, so that none comes from the cache."""
    T_world_cameras = [T for _, T in session.poses()]
    rng = np.random.default_rng(0)
    poses = [T_world_cameras[i % len(T_world_cameras)] for i in range(1000)]
    return [pose @ se3.exp(rng.normal(0, _OFF_PATH)) for pose in poses]


def asked(ask: Callable[[int], object], seconds: float) -> list[float]:
    """Milliseconds of each request, one after the other for so long."""
    times_ms: list[float] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        ask(len(times_ms))
        times_ms.append(1e3 * (time.perf_counter() - start))
    return times_ms


def spread(name: str, times_ms: list[float]) -> dict[str, Any]:
    """Median and tail of times."""
    p50, p95 = np.percentile(times_ms, [50, 95])
    return {f"{name}s": len(times_ms), f"{name}_ms_p50": float(p50), f"{name}_ms_p95": float(p95)}
