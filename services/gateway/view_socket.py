"""Views over a WebSocket, for those who move through the map: the newest camera wins.

The client sends cameras as JSON whenever it moves, as often as it likes. One view is drawn at a
time; while it is, newer cameras take the place of older ones that wait. While the camera rests,
the picture follows the map: it comes again when the map has changed.
"""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import dataclass, replace

from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.gateway.colour_maps import LAYERS, picture
from services.gateway.config import GatewayConfig
from services.gateway.decode import MAX_T_NS, matrix_of, plain
from services.gateway.errors import MESSAGE, detail
from services.gateway.map_queries import ask_render
from services.gateway.problems import problem_response
from services.gateway.session import Session
from services.gateway.sessions import Sessions
from services.gateway.views import mean_confidence
from shared import codec, images
from shared.camera import Intrinsics
from shared.errors import InputError, PointSlamError
from shared.maps import RenderReply, RenderRequest
from shared.se3 import Pose

_JPEG_QUALITY = 85
_MAX_TEXT = 4096  # characters of one camera


@dataclass(frozen=True)
class ViewCamera:
    """Which view a client wants; `id` comes back with it."""

    T_map_camera: Pose
    intrinsics: Intrinsics
    id: int = 0
    layer: str = "colour"
    appearance_t_ns: int | None = None

    def request(self, max_pixels: int) -> RenderRequest:
        """The view as the map's owner draws it.

        Raises:
            InputError: names the field.
        """
        size = self.intrinsics
        size.check("intrinsics")
        if size.width * size.height > max_pixels:
            raise InputError("intrinsics.width", f"at most {max_pixels} pixels")
        if self.layer not in LAYERS:
            raise InputError("layer", f"must be one of {', '.join(LAYERS)}")
        if abs(self.appearance_t_ns or 0) >= MAX_T_NS:
            raise InputError("appearance_t_ns", f"must be less than {MAX_T_NS}")
        T = matrix_of(self.T_map_camera, "T_map_camera")
        return RenderRequest(T, size, self.appearance_t_ns)


def view_routes(sessions: Sessions) -> APIRouter:
    """The route of views as a stream."""
    router = APIRouter()

    @router.websocket("/v1/sessions/{name}/view")
    async def view(websocket: WebSocket, name: str) -> None:
        try:
            session = await sessions.get(name)
        except PointSlamError as error:
            await websocket.send_denial_response(problem_response(error))
            return
        await websocket.accept()
        with session.usage.held():
            await ViewStream(websocket, session, sessions.fabric.config).run()

    return router


class ViewStream:
    """One client's views: a reader that keeps the newest camera, a writer that draws it."""

    def __init__(self, websocket: WebSocket, session: Session, config: GatewayConfig) -> None:
        self._websocket = websocket
        self._session = session
        self._config = config
        self._wanted: str | None = None  # the newest camera that is not drawn yet
        self._moved = asyncio.Event()

    async def run(self) -> None:
        """Serve until the client goes, or does not read for too long."""
        writer, reader = asyncio.create_task(self._write()), asyncio.create_task(self._read())
        try:
            done, _ = await asyncio.wait({writer, reader}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except (WebSocketDisconnect, TimeoutError):
            return  # it went away, or does not read
        finally:
            writer.cancel()
            reader.cancel()

    async def _read(self) -> None:
        while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
            self._wanted = message.get("text") or ""
            self._moved.set()

    async def _write(self) -> None:
        camera, state = None, ""
        while True:
            try:
                if await self._has_moved():
                    camera, state = None, ""
                    camera = self._camera()
                if camera is not None:
                    state = await self._draw(camera, state)
            except PointSlamError as error:
                await self._refuse(camera, error)
                camera = None

    async def _has_moved(self) -> bool:
        """Wait for a camera, or for so long that the map may have changed."""
        try:
            async with asyncio.timeout(self._config.stream.follow_interval_s):
                await self._moved.wait()
        except TimeoutError:
            return False
        self._moved.clear()
        return True

    def _camera(self) -> ViewCamera:
        text = self._wanted or ""
        try:
            if len(text) > _MAX_TEXT:
                raise ValueError(f"longer than {_MAX_TEXT} characters")
            camera = plain(ViewCamera, json.loads(text))
        except (ValueError, RecursionError) as error:
            raise InputError(MESSAGE, f"not a camera as JSON ({str(error)[:100]})") from None
        camera.request(self._config.limits.max_render_pixels)
        return camera

    async def _draw(self, camera: ViewCamera, state: str) -> str:
        """Send the view unless the client has it; the state of the map that it shows."""
        start = time.perf_counter()
        request = camera.request(self._config.limits.max_render_pixels)
        reply = await ask_render(self._session, replace(request, unless_state=state), self._config)
        if reply.state == state:
            return state
        about, jpeg = await asyncio.to_thread(_encoded, reply, camera)
        about["render_ms"] = 1e3 * (time.perf_counter() - start)
        await self._send(about, jpeg)
        return reply.state

    async def _refuse(self, camera: ViewCamera | None, error: PointSlamError) -> None:
        about = {"id": camera.id if camera else None, "error": codec.to_json(detail(error))}
        await self._send(about, None)

    async def _send(self, about: dict, jpeg: bytes | None) -> None:
        async with asyncio.timeout(self._config.stream.send_timeout_s):
            await self._websocket.send_text(json.dumps(about))
            if jpeg is not None:
                await self._websocket.send_bytes(jpeg)


def _encoded(reply: RenderReply, camera: ViewCamera) -> tuple[dict, bytes]:
    layer = picture(reply, camera.layer)
    about = {
        "id": camera.id,
        "map_revision": reply.revision,
        "state": reply.state,
        "confidence": mean_confidence(reply),
        "range_m": layer.range_m,
    }
    return about, images.encode_jpeg(layer.rgb, _JPEG_QUALITY).bytes
