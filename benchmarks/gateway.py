"""How much the gateway carries: clients that stream frames at a fixed rate, and a quick tracker.

`pointslam bench gateway`: 4 clients x 30 frames/s x 300 kB with trackers that take 5 ms, through
a real gateway process and a router. Tells replies lost and the latency that a client sees.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.local_gateway import LocalGateway, local_gateway
from pointslam.client import Client, Session
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage, TrackingStatus
from shared.stream import FrameMessage, FrameReply

SIZE = Intrinsics(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
CALIBRATION = Calibration(Camera(SIZE), depth_scale=1000.0)
JPEG_HEAD = b"\xff\xd8\xff\xc0\x00\x11\x08" + (240).to_bytes(2, "big") + (320).to_bytes(2, "big")
DEPTH_BYTES = 2 * 320 * 240


@dataclass(frozen=True)
class Load:
    """What the clients do."""

    clients: int = 4
    frames_per_s: float = 30.0
    frame_bytes: int = 300_000
    seconds: float = 10.0
    tracker_ms: float = 5.0
    trackers: int = 2


@dataclass
class Seen:
    """What one client saw."""

    sent_s: dict[int, float] = field(default_factory=dict)
    latencies_ms: list[float] = field(default_factory=list)
    superseded: int = 0
    refused: int = 0

    def add(self, reply: FrameReply) -> None:
        """Count one reply."""
        self.latencies_ms.append(1e3 * (time.perf_counter() - self.sent_s[reply.seq]))
        self.superseded += reply.status is TrackingStatus.SUPERSEDED
        self.refused += reply.error is not None


def frames(session: Session, load: Load, seen: Seen) -> Iterator[FrameMessage]:
    """Frames at the load's rate; late ones follow at once."""
    padding = load.frame_bytes - DEPTH_BYTES - len(JPEG_HEAD) - 2
    rgb = ColourImage(ColourEncoding.JPEG, JPEG_HEAD + bytes(max(0, padding)) + b"\xff\xd9")
    depth = DepthImage(DepthEncoding.RAW16, bytes(DEPTH_BYTES))
    start = time.perf_counter()
    for i in range(int(load.seconds * load.frames_per_s)):
        time.sleep(max(0.0, start + i / load.frames_per_s - time.perf_counter()))
        frame = session.frame(rgb, depth, i + 1)
        seen.sent_s[frame.seq] = time.perf_counter()
        yield frame


def stream(url: str, load: Load, seen: Seen) -> None:
    """One client's stream from beginning to end."""
    with Client(url) as client:
        session = client.create_session(CALIBRATION, mode="live")
        for reply in session.stream(frames(session, load, seen)):
            seen.add(reply)


def measure(gateway: LocalGateway, load: Load) -> dict[str, Any]:
    """Run all clients at once and sum up what they saw."""
    for tracker in gateway.trackers:
        tracker.delay_s = load.tracker_ms / 1e3
    everyone = [Seen() for _ in range(load.clients)]
    threads = [threading.Thread(target=stream, args=(gateway.url, load, seen)) for seen in everyone]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wall_s = time.perf_counter() - start
    return summary(load, everyone, wall_s)


def summary(load: Load, everyone: list[Seen], wall_s: float) -> dict[str, Any]:
    """The table's numbers."""
    latencies = np.concatenate([seen.latencies_ms for seen in everyone])
    sent = sum(len(seen.sent_s) for seen in everyone)
    return {
        "clients": load.clients,
        "frames_per_s": load.frames_per_s,
        "frame_bytes": load.frame_bytes,
        "tracker_ms": load.tracker_ms,
        "frames": sent,
        "replies_lost": sent - len(latencies),
        "superseded": sum(seen.superseded for seen in everyone),
        "refused": sum(seen.refused for seen in everyone),
        "latency_ms_p50": float(np.percentile(latencies, 50)),
        "latency_ms_p99": float(np.percentile(latencies, 99)),
        "latency_ms_max": float(latencies.max()),
        "wall_s": wall_s,
    }


def main(argv: list[str]) -> int:
    """Measure and print; exit code 1 if a reply was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--seconds", type=float, default=Load.seconds)
    parser.add_argument("--clients", type=int, default=Load.clients)
    arguments = parser.parse_args(argv)
    load = Load(clients=arguments.clients, seconds=arguments.seconds)
    with local_gateway(load.trackers) as gateway:
        wait_until_ready(gateway.url)
        result = measure(gateway, load)
    if arguments.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(
                f"{name:16} {value:10.1f}" if isinstance(value, float) else f"{name:16} {value:>10}"
            )
    return 1 if result["replies_lost"] or result["refused"] else 0


def wait_until_ready(url: str) -> None:
    """Wait until sessions can be created."""
    with Client(url) as client:
        while not client.ready():
            time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
