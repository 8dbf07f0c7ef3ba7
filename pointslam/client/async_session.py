"""One session, as the asynchronous client sees it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator
from contextlib import AsyncExitStack, aclosing, asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from pointslam.client import calls, path_render, refinement
from pointslam.client.frame_stream import StreamTarget, refusal
from pointslam.client.messages import FrameOptions, frame_message, localize_message
from pointslam.client.progress import POLL_S, Progress, pending
from shared import codec
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import NotFoundError, UnavailableError
from shared.frames import ColourImage, DepthImage
from shared.localization import LocalizeReply
from shared.maps import ExportFormat, JobStatus, RenderReply
from shared.path_renders import PathRenderRequest
from shared.stream import FrameMessage, FrameReply

if TYPE_CHECKING:
    from pointslam.client.asynchronous import AsyncClient


class AsyncSession:
    """One session; counts its frames."""

    def __init__(self, client: AsyncClient, info: dict[str, Any]) -> None:
        self.name: str = info["session"]
        self.mode: str = info["mode"]
        self.next_seq: int = info["tracking"]["last_seq"] + 1
        self._credit: int = info["tracking"]["credit"]
        self._client = client

    def frame(
        self,
        rgb: NDArray[np.uint8] | ColourImage,
        depth: NDArray[np.uint16] | DepthImage,
        t_ns: int,
        options: FrameOptions | None = None,
    ) -> FrameMessage:
        """The next frame, numbered, for `stream`."""
        self.next_seq += 1
        return frame_message(self.next_seq - 1, t_ns, rgb, depth, options)

    async def track(
        self,
        rgb: NDArray[np.uint8] | ColourImage,
        depth: NDArray[np.uint16] | DepthImage,
        t_ns: int,
        *,
        may_be_keyframe: bool = True,
        T_odom_camera: NDArray[np.float64] | None = None,
    ) -> FrameReply:
        """Send one frame and wait for its pose; see `Session.track`."""
        options = FrameOptions(may_be_keyframe, T_odom_camera)
        message = frame_message(self.next_seq, t_ns, rgb, depth, options)
        self.next_seq += 1
        return await self._client.call(calls.track(self.name, message))

    async def stream(self, frames: AsyncIterable[FrameMessage]) -> AsyncIterator[FrameReply]:
        """Send frames over a WebSocket and yield their replies in order; see `Session.stream`."""
        target = StreamTarget(calls.stream_url(self._client.url, self.name), self._client.headers)
        async with aclosing(self._replies(target, frames)) as replies:
            async for reply in replies:
                self.next_seq = max(self.next_seq, reply.seq + 1)
                yield reply

    async def watch(
        self, frames: AsyncIterable[FrameMessage], device: Calibration | None = None
    ) -> AsyncIterator[FrameReply]:
        """Follow a camera in this session's map, which does not change; see `Session.watch`."""
        url = calls.watch_url(self._client.url, self.name)
        target = StreamTarget(url, self._client.headers, calls.device_text(device))
        async with aclosing(self._replies(target, frames)) as replies:
            async for reply in replies:
                yield reply

    async def _replies(
        self, target: StreamTarget, frames: AsyncIterable[FrameMessage]
    ) -> AsyncGenerator[FrameReply, None]:
        async with _open(target) as connection:
            credit = asyncio.Semaphore(self._credit) if self.mode == "offline" else None
            sent: asyncio.Queue[bool] = asyncio.Queue()
            sender = asyncio.create_task(_send_all(connection, frames, credit, sent))
            try:
                while await sent.get():
                    reply = codec.unpack(FrameReply, await _receive(connection))
                    if credit is not None:
                        credit.release()
                    yield reply
                await sender
            finally:
                sender.cancel()

    async def localize(
        self,
        rgb: NDArray[np.uint8] | ColourImage,
        depth: NDArray[np.uint16] | DepthImage | None = None,
        *,
        device: Calibration | Camera | None = None,
        T_map_camera_prior: NDArray[np.float64] | None = None,
    ) -> LocalizeReply:
        """Find one image in this session's map; see `Session.localize`."""
        message = localize_message(rgb, depth, device, T_map_camera_prior)
        return await self._client.call(calls.localize(self.name, message))

    async def pose(self, t_ns: int | None = None) -> NDArray[np.float64]:
        """T_map_camera, [4, 4]: the newest, or at a time, interpolated."""
        return await self._client.call(calls.pose(self.name, t_ns))

    async def poses(self, kind: str = "final") -> list[tuple[int, NDArray[np.float64]]]:
        """(t_ns, T_map_camera) of every tracked frame, `online` as told or `final` as of now."""
        return calls.poses_of(await self.trajectory(), kind)

    async def trajectory(self) -> list[calls.TrajectoryRecord]:
        """Every answered frame."""
        return await self._client.call(calls.trajectory(self.name))

    async def render(
        self,
        T_world_camera: NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        appearance_t_ns: int | None = None,
    ) -> RenderReply:
        """A view of the map; without intrinsics, through the session's colour camera."""
        call = calls.render(self.name, T_world_camera, intrinsics, appearance_t_ns)
        return await self._client.call(call)

    async def render_path(
        self, request: PathRenderRequest, progress: Progress | None = None
    ) -> AsyncIterator[bytes]:
        """The file with views along a path, piece by piece; see `Session.render_path`."""
        status = await self._client.call(path_render.start(self.name, request))
        try:
            while status.is_running:
                await asyncio.sleep(POLL_S)
                status = await self._client.call(path_render.status(self.name, status.job))
                if progress is not None:
                    progress(status.frames_done, status.frames_total)
            file = path_render.file_path(self.name, path_render.succeeded(status).job)
            async for piece in self._client.download(file, {}):
                yield piece
        finally:
            with suppress(NotFoundError, UnavailableError):
                await self._client.call(path_render.cancel(self.name, status.job))

    async def info(self) -> dict[str, Any]:
        """State of the map (fields of MapInfo) and of tracking."""
        return await self._client.call(calls.info(self.name))

    async def refine(self, iterations: int, progress: Progress | None = None) -> JobStatus:
        """Optimise the map on all keyframes; returns when it is done or interrupted."""
        job = await self.start_refinement(iterations)
        async for job in self.refinement_events():
            if progress is not None:
                progress(job.iterations_done, job.iterations_total)
        return refinement.succeeded(job)

    async def start_refinement(self, iterations: int) -> JobStatus:
        """Start to optimise the map on all keyframes; it goes on without this client."""
        return await self._client.call(refinement.start(self.name, iterations))

    async def refinement_events(self) -> AsyncIterator[JobStatus]:
        """The present or the last refinement whenever it has moved, until it has ended."""
        is_running, path = True, refinement.events_path(self.name)
        while is_running:
            try:
                async for line in self._client.lines(path):
                    if (job := refinement.job_in(line)) is not None:
                        is_running = job.is_running
                        yield job
            except UnavailableError:
                await asyncio.sleep(POLL_S)  # the stream broke; perhaps the gateway did not
                is_running = (await self.refinement()).is_running

    async def refinement(self) -> JobStatus:
        """The present or the last refinement."""
        return await self._client.call(refinement.status(self.name))

    async def wait_until_mapped(self) -> None:
        """Wait until the map has worked through every answered frame."""
        while pending(await self.info()) > 0:
            await asyncio.sleep(POLL_S)

    async def export(self, format: ExportFormat | str) -> AsyncIterator[bytes]:
        """The map as a file, piece by piece; see `ExportFormat`."""
        params = {"format": str(ExportFormat(format))}
        async for piece in self._client.download(calls.export_path(self.name), params):
            yield piece

    async def interrupt(self) -> JobStatus:
        """End a refinement; a live map rests until the next frame."""
        return await self._client.call(refinement.interrupt(self.name))

    async def save(self) -> dict[str, Any]:
        """Write a snapshot; returns when it is on disk."""
        return await self._client.call(calls.save(self.name))

    async def delete(self) -> None:
        """Remove the session and every byte of it."""
        await self._client.call(calls.delete(self.name))


async def _send_all(
    connection: ClientConnection,
    frames: AsyncIterable[FrameMessage],
    credit: asyncio.Semaphore | None,
    sent: asyncio.Queue[bool],
) -> None:
    """Send every frame; puts True for each one sent and False at the end."""
    try:
        async for frame in frames:
            if credit is not None:
                await credit.acquire()
            await connection.send(codec.pack(frame))
            sent.put_nowait(True)
    except ConnectionClosed:
        sent.put_nowait(True)  # the reader sees the same and tells
    finally:
        sent.put_nowait(False)


@asynccontextmanager
async def _open(target: StreamTarget) -> AsyncIterator[ClientConnection]:
    url, headers = target.url, target.headers
    async with AsyncExitStack() as stack:
        try:
            connection = await stack.enter_async_context(
                connect(url, additional_headers=headers, compression=None, ping_timeout=120)
            )
            if target.greeting is not None:
                await connection.send(target.greeting)
        except InvalidStatus as error:
            raise calls.error_from(refusal(error)) from None
        except (OSError, TimeoutError) as error:
            raise UnavailableError(f"{url} does not answer ({error})") from None
        yield connection


async def _receive(connection: ClientConnection) -> bytes:
    try:
        data = await connection.recv()
    except ConnectionClosed as error:
        raise UnavailableError(f"the frame stream broke: {error}") from None
    return data if isinstance(data, bytes) else data.encode()
