"""The console as its user meets it, while the map is optimised beside it on the same cores.

    pointslam bench console SEQUENCE [--frames 60] [--seconds 10] [--json]

Views are asked for over the WebSocket as the page does, one after the other, each off the camera's
path and new. The page is opened in a Chromium without a GPU, if there is one: how many bytes it
loads, and when its first picture of the map is there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from benchmarks.browser import chromium_path, open_page
from benchmarks.renders_http import asked, novel_views, spread
from pointslam.client import Client, Session
from pointslam.datasets import FileSequence, open_sequence
from pointslam.launcher import LaunchOptions, Services
from pointslam.streaming import StreamOptions, stream_sequence
from shared import codec
from shared.camera import Intrinsics
from shared.se3 import Pose

_ENDLESS = 1_000_000  # iterations
_VIEW = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
_PICTURE = "document.getElementById('stage')?.dataset.exact"


def measure(sequence: FileSequence, frames: int, seconds: float) -> dict[str, Any]:
    """Services as processes, with a session that is being refined."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = LaunchOptions(folder / "data", folder / "logs", num_trackers=1)
        with Services(options) as services, Client(services.url) as client:
            session = client.create_session(sequence.calibration, mode="offline")
            stream_sequence(session, sequence, StreamOptions(frames, 0, False))
            session.wait_until_mapped()
            session.start_refinement(_ENDLESS)
            before = session.info()["iterations"]
            views = _views(services.url, session, seconds)
            done = session.info()["iterations"] - before
            return views | {"iterations_per_s": done / seconds} | _page(services.url)


def _views(url: str, session: Session, seconds: float) -> dict[str, Any]:
    poses = [codec.to_json(Pose.from_matrix(T)) for T in novel_views(session)]
    size = codec.to_json(_VIEW)
    address = f"{url.replace('http', 'ws')}/v1/sessions/{session.name}/view"
    with connect(address, compression=None, max_size=None) as socket:

        def ask(i: int) -> None:
            camera = {"T_map_camera": poses[i % len(poses)], "intrinsics": size, "id": i + 1}
            socket.send(json.dumps(camera))
            while json.loads(socket.recv())["id"] != i + 1:  # the one before, as the map moved on
                socket.recv()
            socket.recv()

        return spread("view", asked(ask, seconds))


def _page(url: str) -> dict[str, Any]:
    path = chromium_path()
    if path is None:
        return {}
    with open_page(path) as page:
        page.send("Network.setCacheDisabled", cacheDisabled=True)
        page.open(f"{url}/capture")  # a browser's own start is not the console's
        page.wait_for("document.body?.dataset.ready === 'true'")
        page.forget()
        start = time.perf_counter()
        page.open(f"{url}/")
        page.wait_for(_PICTURE, timeout_s=60.0)
        return {
            "first_picture_s": time.perf_counter() - start,
            "page_mb": page.received_bytes / 1e6,
            "page_errors": page.errors,
        }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = measure(open_sequence(arguments.sequence), arguments.frames, arguments.seconds)
    lines = [f"{name:18} {value}" for name, value in found.items()]
    sys.stdout.write(json.dumps(found) if arguments.json else "\n".join(lines))
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
