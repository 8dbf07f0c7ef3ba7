"""A headless Chromium driven over its DevTools protocol: a page as its users see it."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL 2 without a GPU, and a camera that is a test picture.
FLAGS = (
    "--headless=new --no-sandbox --disable-dev-shm-usage --no-first-run --disable-extensions "
    "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--use-fake-device-for-media-stream --use-fake-ui-for-media-stream "
    "--remote-debugging-port=0 about:blank"
)
_START_S = 120.0
_ANSWER_S = 120.0
_STEPS = 8  # of a drag


def chromium_path() -> str | None:
    """The browser of this machine, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """One tab. What it says of errors is in `errors`."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._id = 0
        self.errors: list[str] = []
        self.received_bytes = 0
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        # A screenshot of the whole page has no scroll bar, and would be wider than it is cut.
        self.send("Emulation.setScrollbarsHidden", hidden=True)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A DevTools command; hears of events until its answer comes."""
        self._id += 1
        self._connection.send(json.dumps({"id": self._id, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._connection.recv(_ANSWER_S))
            if message.get("id") == self._id:
                assert "error" not in message, message
                return message["result"]
            self._hear(message)

    def open(self, url: str) -> None:
        """Begin to load a page."""
        self.send("Page.navigate", url=url)

    def forget(self) -> None:
        """Leave the page, and forget what it said and loaded."""
        self.open("about:blank")
        self.wait_for("location.href === 'about:blank'")
        self.errors.clear()
        self.received_bytes = 0

    def run(self, script: str) -> Any:
        """The value of an expression in the page; promises are waited for."""
        answer = self.send(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, script: str, timeout_s: float = 120.0) -> Any:
        """Wait until an expression is true; its value."""
        deadline = time.monotonic() + timeout_s
        while not (value := self.run(script)):
            assert time.monotonic() < deadline, f"not within {timeout_s} s: {script}; {self.errors}"
            time.sleep(0.05)
        return value

    def text(self, selector: str) -> str:
        """What an element says."""
        return self.run(f"document.querySelector({json.dumps(selector)}).innerText.trim()")

    def click(self, selector: str) -> None:
        """Press and release the mouse in the middle of an element."""
        x, y = self._centre(selector)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y)

    def drag(self, selector: str, dx: float, dy: float, at: float = 0.5) -> None:
        """Drag from a share `at` of an element's width, at half its height."""
        x, y = self._centre(selector, at)
        self.mouse("mousePressed", x, y)
        for i in range(1, _STEPS + 1):
            self.mouse("mouseMoved", x + dx * i / _STEPS, y + dy * i / _STEPS)
        self.mouse("mouseReleased", x + dx, y + dy)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """One mouse event with the left button, page pixels."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, key: str) -> None:
        """Press and release a key where the focus is."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def resize(self, width: int, height: int, scheme: str = "dark") -> None:
        """The size of the window, and whether the system asks for dark or light."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.send("Emulation.setDeviceMetricsOverride", **metrics)
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.send("Emulation.setEmulatedMedia", features=[feature])

    def screenshot(self, path: Path, quality: int = 88) -> None:
        """The whole page as a JPEG."""
        size = self.send("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        answer = self.send(
            "Page.captureScreenshot",
            format="jpeg",
            quality=quality,
            clip=clip,
            captureBeyondViewport=True,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(answer["data"]))

    def _centre(self, selector: str, at: float = 0.5) -> tuple[float, float]:
        box = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const b = e.getBoundingClientRect();"
            f" return [b.x + b.width * {at}, b.y + b.height / 2]; }})()"
        )
        return box[0], box[1]

    def _hear(self, message: dict[str, Any]) -> None:
        method, what = message["method"], message["params"]
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(what["exceptionDetails"].get("exception") or what))
        elif method == "Runtime.consoleAPICalled" and what["type"] in ("error", "warning"):
            self.errors.append(" ".join(str(a.get("value", a)) for a in what["args"]))
        elif method == "Log.entryAdded" and what["entry"]["level"] == "error":
            self.errors.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")
        elif method == "Network.loadingFinished":
            self.received_bytes += what["encodedDataLength"]


@contextmanager
def open_page(path: str) -> Iterator[Page]:
    """A tab of a new browser, which ends with it."""
    with tempfile.TemporaryDirectory() as profile:
        command = [path, f"--user-data-dir={profile}", *FLAGS.split()]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(profile) / "DevToolsActivePort", process)
            tabs = httpx.get(f"http://127.0.0.1:{port}/json/list").json()
            url = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
            with connect(url, max_size=None, ping_interval=None) as connection:
                yield Page(connection)
        finally:
            process.terminate()
            process.wait(60.0)


def _port(file: Path, process: subprocess.Popen[bytes]) -> int:
    deadline = time.monotonic() + _START_S
    while not file.exists() or not file.read_text().strip():
        assert process.poll() is None, "the browser ended"
        assert time.monotonic() < deadline, "the browser does not start"
        time.sleep(0.05)
    return int(file.read_text().split()[0])
