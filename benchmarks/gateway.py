"""How much the gateway carries: clients that stream frames at a fixed rate, and a quick tracker.

`pointslam bench gateway`: 16 clients x 15 frames/s x 300 kB with trackers that take 5 ms, through
a real gateway process and a router; one more client asks for poses over gRPC all the while. Tells
replies lost, the latencies that clients see, what memory the gateway gained, and the processor
time that a frame took of the gateway, of the clients, and of the stand-ins with the router: what
else the machine does changes latencies, and hardly these. The clients have processes of their own,
and each begins at a random moment of a frame's time.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import grpc
import numpy as np

from benchmarks.cluster import cpu_s, rss_mb
from benchmarks.local_gateway import LocalGateway, local_gateway
from pointslam.client import Client, Session
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage, TrackingStatus
from shared.stream import FrameMessage, FrameReply
from shared.wire import pose_service_pb2, pose_service_pb2_grpc

SIZE = Intrinsics(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
CALIBRATION = Calibration(Camera(SIZE), depth_scale=1000.0)
JPEG_HEAD = b"\xff\xd8\xff\xc0\x00\x11\x08" + (240).to_bytes(2, "big") + (320).to_bytes(2, "big")
DEPTH_BYTES = 2 * 320 * 240


@dataclass(frozen=True)
class Load:
    """What the clients do."""

    clients: int = 16
    frames_per_s: float = 15.0
    frame_bytes: int = 300_000
    seconds: float = 10.0
    tracker_ms: float = 5.0
    trackers: int = 2  # each takes two frames at a time, as real ones do
    poses_per_s: float = 50.0


_CLIENT_PROCESSES = 2
_WARM_S = 2.0  # then memory is what it will be


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


def stream(url: str, load: Load, index: int, seen: Seen) -> None:
    """One client's stream from beginning to end."""
    time.sleep(np.random.default_rng(index).uniform(0.0, 1.0 / load.frames_per_s))
    with Client(url) as client:
        session = client.session(_session(index))
        for reply in session.stream(frames(session, load, seen)):
            seen.add(reply)


def _session(index: int) -> str:
    return f"load-{index}"


def stream_all(url: str, load: Load, indices: range) -> tuple[list[Seen], float]:
    """What some of the clients saw, in a process of their own, and its processor time in s."""
    start_s = time.process_time()
    everyone = {index: Seen() for index in indices}
    threads = [
        threading.Thread(target=stream, args=(url, load, *each)) for each in everyone.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return list(everyone.values()), time.process_time() - start_s


def ask_poses(address: str, load: Load) -> list[float]:
    """Pose queries over gRPC at a fixed rate, of one session after another; milliseconds."""
    times_ms = []
    with grpc.insecure_channel(address) as channel:
        stub = pose_service_pb2_grpc.PoseServiceStub(channel)
        start = time.perf_counter() + _WARM_S  # by then every session has a pose
        for i in range(int((load.seconds - _WARM_S) * load.poses_per_s)):
            time.sleep(max(0.0, start + i / load.poses_per_s - time.perf_counter()))
            request = pose_service_pb2.GetPoseRequest(session_id=_session(i % load.clients))
            asked = time.perf_counter()
            stub.GetPose(request)
            times_ms.append(1e3 * (time.perf_counter() - asked))
    return times_ms


def measure(gateway: LocalGateway, load: Load) -> dict[str, Any]:
    """Run all clients at once and sum up what they saw."""
    for tracker in gateway.trackers:
        tracker.delay_s = load.tracker_ms / 1e3
    with Client(gateway.url) as client:
        for index in range(load.clients):
            client.create_session(CALIBRATION, name=_session(index), mode="live")
    spawn = multiprocessing.get_context("spawn")
    gc.freeze()  # trackers, mapper and router are in this process
    with ProcessPoolExecutor(_CLIENT_PROCESSES + 1, spawn, initializer=gc.freeze) as pool:
        start, start_cpu_s = time.perf_counter(), (cpu_s(gateway.pid), time.process_time())
        poses = pool.submit(ask_poses, gateway.grpc_address, load)
        streams = [
            pool.submit(stream_all, gateway.url, load, range(part, load.clients, _CLIENT_PROCESSES))
            for part in range(_CLIENT_PROCESSES)
        ]
        time.sleep(min(_WARM_S + 3.0, load.seconds))
        before_mb = rss_mb(gateway.pid)
        parts = [part.result() for part in streams]
        gained_mb = rss_mb(gateway.pid) - before_mb
        wall_s = time.perf_counter() - start
        found = summary(load, [seen for part, _ in parts for seen in part], wall_s)
        found["gateway_mb_gained"] = gained_mb
        cpu = {
            "gateway": cpu_s(gateway.pid) - start_cpu_s[0],
            "clients": sum(seconds for _, seconds in parts),
            "stand_ins": time.process_time() - start_cpu_s[1],
        }
        found |= {f"cpu_ms_{who}": 1e3 * used_s / found["frames"] for who, used_s in cpu.items()}
        return found | percentiles("pose_query_ms", poses.result())


def percentiles(name: str, values: list[float]) -> dict[str, float]:
    """Median, 99th percentile and maximum."""
    p50, p99, largest = np.percentile(values or [0.0], (50, 99, 100))
    return {f"{name}_p50": float(p50), f"{name}_p99": float(p99), f"{name}_max": float(largest)}


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
        "wall_s": wall_s,
    } | percentiles("latency_ms", latencies.tolist())


def main(argv: list[str]) -> int:
    """Measure and print; exit code 1 if a reply was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--seconds", type=float, default=Load.seconds)
    parser.add_argument("--clients", type=int, default=Load.clients)
    parser.add_argument("--rate", type=float, default=Load.frames_per_s, help="frames/s of each")
    arguments = parser.parse_args(argv)
    load = Load(clients=arguments.clients, frames_per_s=arguments.rate, seconds=arguments.seconds)
    with local_gateway(load.trackers) as gateway:
        wait_until_ready(gateway.url)
        result = measure(gateway, load)
    if arguments.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(
                f"{name:18} {value:10.1f}" if isinstance(value, float) else f"{name:18} {value:>10}"
            )
    return 1 if result["replies_lost"] or result["refused"] else 0


def wait_until_ready(url: str) -> None:
    """Wait until sessions can be created."""
    with Client(url) as client:
        while not client.ready():
            time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
