"""Nonsense for every door of a real gateway: what it answers, whether it lives, what it keeps.

    pointslam bench fuzz [--inputs 10000] [--seed 0] [--json]

Routes are taken from its OpenAPI and its RPCs from the table of scopes; inputs are mutations of
good ones, and those that schemathesis makes of the OpenAPI. It fails when an answer blames the
gateway (5xx, INTERNAL, UNKNOWN), the process ends, or it holds more memory after the inputs than
its allocator explains.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from benchmarks.fuzz_inputs import spoiled, spoiled_bytes, spoiled_message, strange_word
from benchmarks.fuzz_openapi import send_cases
from benchmarks.local_gateway import PATIENCE, LocalGateway, local_gateway
from pointslam.client import Client, frame_message
from pointslam.client.frame_stream import open_stream
from services.gateway.access.routes import GRPC
from shared import codec
from shared.camera import Calibration, Camera, Intrinsics
from shared.stream import FrameReply
from shared.wire import map_service_pb2, session_service_pb2, tracking_service_pb2, types_pb2

_GROWTH_MB = 48.0  # the allocator keeps what a burst once needed
_NAME = "fuzzed"
_CALIBRATION = Calibration(Camera(Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)), depth_scale=1000.0)
_STREAMED = ("TrackFrames", "ServerReflectionInfo")
_STREAMING = ("WatchPoses", "ExportMap", "Watch")


@dataclass
class Outcome:
    """What one door answered to its inputs."""

    answers: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0
    growth_mb: float = 0.0

    def count(self, answer: str, is_fault: bool, what: str) -> None:
        """Note an answer; of faults what led to it is kept."""
        self.answers[answer] += 1
        if is_fault:
            self.faults.append(f"{answer}: {what[:300]}")


class Fuzzer:
    """One gateway and one session on it, which is made again when an input has deleted it."""

    def __init__(self, gateway: LocalGateway, seed: int) -> None:
        self._gateway = gateway
        self._rng = random.Random(seed)
        self._http = httpx.Client(base_url=gateway.url, timeout=60.0)
        self._stack = ExitStack()
        self._socket: ClientConnection | None = None
        self._channel = grpc.insecure_channel(gateway.grpc_address)
        self._routes = _routes(self._http.get("/openapi.json").json())
        rgb = np.zeros((48, 64, 3), np.uint8)
        self._frame = codec.to_plain(frame_message(0, 1, rgb, np.full((48, 64), 1500, np.uint16)))
        self._ensure_session()

    def http(self, outcome: Outcome) -> None:
        """One request to some route."""
        method, path, example = self._rng.choice(self._routes)
        path = path.replace("{name}", _NAME if self._rng.random() < 0.7 else "nobody")
        while "{" in path:
            path = path[: path.index("{")] + strange_word(self._rng) + path[path.index("}") + 1 :]
        words = {
            name: strange_word(self._rng)
            for name in self._rng.sample(_QUERIES, self._rng.randrange(4))
        }
        body = json.dumps(spoiled(example, self._rng), default=str) if example else None
        try:
            with self._http.stream(method, path, params=words, content=body) as response:
                status = response.status_code
                if "event-stream" not in response.headers.get("content-type", ""):
                    response.read()
        except httpx.TransportError as error:  # answered and closed while the body was under way
            is_dead = self._http.get("/healthz").status_code != 200
            outcome.count(type(error).__name__, is_dead, f"{method} {path} {words}")
            return
        outcome.count(str(status), status >= 500, f"{method} {path} {words} {body}")
        if status == 201 and "location" in response.headers:
            self._http.delete(response.headers["location"])
        if method == "DELETE" or status == 404:
            self._ensure_session()

    def msgpack(self, outcome: Outcome) -> None:
        """One frame, or one image to localize."""
        route = self._rng.choice(("frames", "localize"))
        good = self._frame if route == "frames" else {"rgb": self._frame["rgb"]}
        data = spoiled_message(good, self._rng)
        response = self._http.post(f"/v1/sessions/{_NAME}/{route}", content=data)
        status = response.status_code
        outcome.count(str(status), status >= 500, f"{route} {data[:100]!r} {response.text}")

    def websocket(self, outcome: Outcome) -> None:
        """One message of a frame stream: it is answered, and the stream goes on."""
        data = spoiled_message(self._frame, self._rng)
        message: bytes | str = "text" if self._rng.random() < 0.02 else data
        try:
            if self._socket is None:
                url = f"{self._gateway.url.replace('http', 'ws')}/v1/sessions/{_NAME}/stream"
                self._socket = self._stack.enter_context(open_stream(url))
            self._socket.send(message)
            answer = self._socket.recv(timeout=60.0)
        except ConnectionClosed as error:
            self._socket = None
            code = error.rcvd.code if error.rcvd else 1006
            outcome.count(f"closed {code}", code in (1006, 1011), repr(data[:100]))
            return
        assert isinstance(answer, bytes)
        reply = codec.unpack(FrameReply, answer)
        code = reply.error.code if reply.error else "answered"
        outcome.count(code, code in ("error", "unavailable"), repr(data[:100]))

    def protobuf(self, outcome: Outcome) -> None:
        """One call of some RPC."""
        method = self._rng.choice([name for name in GRPC if name.startswith("/pointslam")])
        request = spoiled_bytes(self._rng.choice(_REQUESTS), self._rng)
        code = _call(self._channel, method, request)
        is_fault = code in ("INTERNAL", "UNKNOWN", "UNAVAILABLE")
        outcome.count(code, is_fault, f"{method} {request[:100]!r}")
        if method.endswith("DeleteSession"):
            self._ensure_session()

    def rss_mb(self) -> float:
        """Memory that the gateway holds; a process that has ended is an error."""
        status = Path(f"/proc/{self._gateway.pid}/status").read_text()
        fields = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        return int(fields["VmRSS"].split()[0]) / 1024.0

    def _ensure_session(self) -> None:
        if self._http.get(f"/v1/sessions/{_NAME}").status_code == 404:
            with Client(self._gateway.url) as client:
                client.create_session(_CALIBRATION, name=_NAME)


_QUERIES = [
    *("t_ns", "kind", "format", "what", "px", "py", "pz", "qw", "fx", "cx", "width", "height"),
    *("T_map_camera", "appearance_t_ns", "frame", "ticket", "seq", "iterations"),
]


def _requests() -> list[bytes]:
    """Good messages of all RPCs."""
    intrinsics = types_pb2.Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
    camera = types_pb2.Camera(intrinsics=intrinsics)
    calibration = types_pb2.Calibration(colour=camera, depth_scale=1000.0)
    pose = types_pb2.Pose(orientation=types_pb2.Quaternion(w=1.0))
    rgb = tracking_service_pb2.ColourImage(encoding="COLOUR_ENCODING_RGB8", bytes=bytes(9216))
    depth = tracking_service_pb2.DepthImage(encoding="DEPTH_ENCODING_RAW16", bytes=bytes(6144))
    frame = tracking_service_pb2.Frame(seq=1, t_ns=1, rgb=rgb, depth=depth)
    messages = (
        session_service_pb2.GetSessionRequest(session_id=_NAME),
        session_service_pb2.CreateSessionRequest(session_id=_NAME, calibration=calibration),
        tracking_service_pb2.TrackFramesRequest(session_id=_NAME, frame=frame),
        tracking_service_pb2.LocalizeRequest(session_id=_NAME, rgb=rgb, depth=depth),
        map_service_pb2.RenderViewRequest(session_id=_NAME, T_map_camera=pose),
    )
    return [message.SerializeToString() for message in messages]


_REQUESTS = _requests()


def _call(channel: grpc.Channel, method: str, request: bytes) -> str:
    """The name of the status of a call; streams are followed to their first answer."""
    try:
        if method.endswith(_STREAMED):
            list(channel.stream_stream(method)(iter([request]), timeout=60))
        elif method.endswith(_STREAMING):
            call = channel.unary_stream(method)(request, timeout=0.1)
            for _ in call:
                call.cancel()
                return "OK"
        else:
            channel.unary_unary(method)(request, timeout=60)
    except grpc.RpcError as error:
        failed: Any = error
        return failed.code().name
    return "OK"


def _routes(openapi: dict[str, Any]) -> list[tuple[str, str, Any]]:
    """Method, path and an example of the JSON body of every route."""
    return [
        (method.upper(), path, _example(operation))
        for path, operations in openapi["paths"].items()
        for method, operation in operations.items()
    ]


def _example(operation: dict[str, Any]) -> Any:
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    examples = [row["value"] for row in content.get("examples", {}).values()]
    return content.get("example", examples[0] if examples else None)


def fuzz(inputs: int, seed: int) -> dict[str, Outcome]:
    """Send so many inputs to each door.

    Raises:
        OSError: the gateway has ended.
    """
    outcomes = {}
    with local_gateway(2, *PATIENCE) as gateway:
        fuzzer = Fuzzer(gateway, seed)
        doors: dict[str, Callable[[Outcome], None]] = {
            "http": fuzzer.http,
            "msgpack": fuzzer.msgpack,
            "websocket": fuzzer.websocket,
            "protobuf": fuzzer.protobuf,
        }
        for name, send in doors.items():
            outcomes[name] = _send_all(send, fuzzer.rss_mb, inputs)
        outcomes["openapi"] = _made_of_openapi(gateway.url, fuzzer.rss_mb, inputs)
    return outcomes


def _made_of_openapi(url: str, rss_mb: Callable[[], float], inputs: int) -> Outcome:
    outcome, before_mb, start = Outcome(), rss_mb(), time.monotonic()
    send_cases(url, _NAME, inputs, lambda code, what: outcome.count(str(code), code >= 500, what))
    outcome.seconds, outcome.growth_mb = time.monotonic() - start, rss_mb() - before_mb
    return outcome


def _send_all(send: Callable[[Outcome], None], rss_mb: Callable[[], float], inputs: int) -> Outcome:
    outcome, before_mb = Outcome(), rss_mb()
    start = time.monotonic()
    for i in range(inputs):
        if i == inputs // 5:  # every path has run once and every pool has its size
            before_mb = rss_mb()
        send(outcome)
    outcome.seconds = time.monotonic() - start
    outcome.growth_mb = rss_mb() - before_mb
    return outcome


def problems(outcomes: dict[str, Outcome]) -> list[str]:
    """What a good gateway would not have done."""
    faults = [f"{name}: {fault}" for name, o in outcomes.items() for fault in o.faults]
    grown = [
        f"{name}: {o.growth_mb:.0f} MB more than after its first fifth"
        for name, o in outcomes.items()
        if o.growth_mb > _GROWTH_MB
    ]
    return faults + grown


def main() -> int:
    """Run, print, and tell by the exit code whether the gateway stood it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    outcomes = fuzz(arguments.inputs, arguments.seed)
    if arguments.json:
        print(json.dumps({name: vars(o) for name, o in outcomes.items()}))
    else:
        for name, o in outcomes.items():
            print(f"{name:10} {o.seconds:6.1f} s {o.growth_mb:+6.1f} MB  {dict(o.answers)}")
    found = problems(outcomes)
    sys.stderr.writelines(f"{line}\n" for line in found[:20])
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
