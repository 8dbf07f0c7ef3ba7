"""One session, as the synchronous client sees it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pointslam.client import calls, path_render, refinement
from pointslam.client.frame_stream import StreamTarget, stream_frames
from pointslam.client.messages import FrameOptions, frame_message, localize_message
from pointslam.client.progress import POLL_S, Progress, pending
from pointslam.client.resuming import Route, resuming
from shared.camera import Calibration, Camera, Intrinsics
from shared.errors import NotFoundError, UnavailableError
from shared.frames import ColourImage, DepthImage
from shared.localization import LocalizeReply
from shared.maps import ExportFormat, JobStatus, RenderReply
from shared.path_renders import PathRenderRequest, PathRenderStatus
from shared.stream import FrameMessage, FrameReply

if TYPE_CHECKING:
    from pointslam.client.synchronous import Client


class Session:
    """One session; counts its frames."""

    def __init__(self, client: Client, info: dict[str, Any]) -> None:
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

    def track(
        self,
        rgb: NDArray[np.uint8] | ColourImage,
        depth: NDArray[np.uint16] | DepthImage,
        t_ns: int,
        *,
        may_be_keyframe: bool = True,
        T_odom_camera: NDArray[np.float64] | None = None,
    ) -> FrameReply:
        """Send one frame and wait for its pose.

        Args:
            rgb: colour, [H, W, 3], or an encoded image.
            depth: raw sensor values, [H, W] (metres are raw / depth_scale), or an encoded image.
            t_ns: the device's clock, nanoseconds; grows from frame to frame.
            may_be_keyframe: False keeps the frame out of the map.
            T_odom_camera: the device's own odometry, [4, 4].

        Raises:
            PointSlamError: the frame was refused; the session goes on.
        """
        options = FrameOptions(may_be_keyframe, T_odom_camera)
        message = frame_message(self.next_seq, t_ns, rgb, depth, options)
        reply = self._client.call(calls.track(self.name, message))
        self.next_seq = message.seq + 1
        return reply

    def stream(self, frames: Iterable[FrameMessage]) -> Iterator[FrameReply]:
        """Send frames over a WebSocket and yield their replies in order.

        Offline, as many are under way as the gateway gives credit for; live, each is sent when
        `frames` yields it, and a reply may say SUPERSEDED. A refused frame's reply has `error`.
        Where the client knows several gateways the stream goes on at the next one when it breaks.

        Raises:
            UnavailableError: the connection broke.
        """
        client = self._client
        route = Route(self._stream_here, self.trajectory, client.turn, len(client.gateways))
        for reply in resuming(frames, route):
            if reply.seq >= self.next_seq:  # never backwards: `frames` counts in another thread
                self.next_seq = reply.seq + 1
            yield reply

    def _stream_here(self, frames: Iterable[FrameMessage]) -> Iterator[FrameReply]:
        url = calls.stream_url(self._client.url, self.name)
        return stream_frames(StreamTarget(url, self._client.headers), frames, self._under_way)

    def watch(
        self, frames: Iterable[FrameMessage], device: Calibration | None = None
    ) -> Iterator[FrameReply]:
        """Follow a camera in this session's map, whoever else streams; the map does not change.

        Replies say LOST, without a pose, until the camera is found. Numbers and times need only
        grow within this stream. As in `stream`, a live session's replies may say SUPERSEDED, and
        where the client knows several gateways the next one finds the camera when one breaks.

        Args:
            frames: made by `frame`, or by any other means.
            device: what takes the images, where it is not the session's device.

        Raises:
            UnavailableError: the connection broke.
        """
        client = self._client

        def watch_here(frames: Iterable[FrameMessage]) -> Iterator[FrameReply]:
            url = calls.watch_url(client.url, self.name)
            target = StreamTarget(url, client.headers, calls.device_text(device))
            return stream_frames(target, frames, self._under_way)

        # Who watches leaves no trace: what was not answered is asked again, all of it.
        return resuming(frames, Route(watch_here, list, client.turn, len(client.gateways)))

    @property
    def _under_way(self) -> int | None:
        """How many frames may be sent before their replies come; None: any number."""
        return self._credit if self.mode == "offline" else None

    def localize(
        self,
        rgb: NDArray[np.uint8] | ColourImage,
        depth: NDArray[np.uint16] | DepthImage | None = None,
        *,
        device: Calibration | Camera | None = None,
        T_map_camera_prior: NDArray[np.float64] | None = None,
    ) -> LocalizeReply:
        """Find one image in this session's map; the session's trajectory is not touched.

        Args:
            rgb: colour, [H, W, 3], or an encoded image.
            depth: raw sensor values, [H, W], or an encoded image; without it the pose comes from
                features alone and the status is COLOUR_ONLY.
            device: what took the image, where it is not the session's device: a Calibration, or
                the Camera of a colour image without depth.
            T_map_camera_prior: where the camera is thought to be, [4, 4]; makes it faster.

        Returns:
            a pose and how good it is; with status NOT_LOCALISED, the reason why there is none.

        Raises:
            PointSlamError: the image was refused.
        """
        message = localize_message(rgb, depth, device, T_map_camera_prior)
        return self._client.call(calls.localize(self.name, message))

    def pose(self, t_ns: int | None = None) -> NDArray[np.float64]:
        """T_map_camera, [4, 4]: the newest, or at a time, interpolated.

        Raises:
            NotFoundError: there is no pose (at that time).
        """
        return self._client.call(calls.pose(self.name, t_ns))

    def poses(self, kind: str = "final") -> list[tuple[int, NDArray[np.float64]]]:
        """(t_ns, T_map_camera) of every tracked frame, `online` as told or `final` as of now."""
        return calls.poses_of(self.trajectory(), kind)

    def trajectory(self) -> list[calls.TrajectoryRecord]:
        """Every answered frame."""
        return self._client.call(calls.trajectory(self.name))

    def render(
        self,
        T_world_camera: NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        appearance_t_ns: int | None = None,
    ) -> RenderReply:
        """A view of the map; without intrinsics, through the session's colour camera."""
        return self._client.call(
            calls.render(self.name, T_world_camera, intrinsics, appearance_t_ns)
        )

    def render_path(
        self, request: PathRenderRequest, path: Path | str, progress: Progress | None = None
    ) -> PathRenderStatus:
        """Draw views along a path into a file: a video, or a zip of pictures and their poses.

        What ends this call early (Ctrl-C) ends the drawing too.

        Raises:
            InputError: the request does not fit the session; names the field.
            ConflictError: another path of the session is being drawn.
            PointSlamError: drawing failed.
        """
        status = self._client.call(path_render.start(self.name, request))
        try:
            while status.is_running:
                time.sleep(POLL_S)
                status = self._client.call(path_render.status(self.name, status.job))
                if progress is not None:
                    progress(status.frames_done, status.frames_total)
            file = path_render.file_path(self.name, path_render.succeeded(status).job)
            self._client.download(file, {}, Path(path))
        finally:
            with suppress(NotFoundError, UnavailableError):  # a gateway that is gone draws nothing
                self._client.call(path_render.cancel(self.name, status.job))
        return status

    def info(self) -> dict[str, Any]:
        """State of the map (fields of MapInfo) and of tracking."""
        return self._client.call(calls.info(self.name))

    def refine(self, iterations: int, progress: Progress | None = None) -> JobStatus:
        """Optimise the map on all keyframes; returns when it is done or interrupted.

        Raises:
            PointSlamError: the refinement failed.
        """
        job = self.start_refinement(iterations)
        for job in self.refinement_events():
            if progress is not None:
                progress(job.iterations_done, job.iterations_total)
        return refinement.succeeded(job)

    def start_refinement(self, iterations: int) -> JobStatus:
        """Start to optimise the map on all keyframes; it goes on without this client.

        Raises:
            ConflictError: a refinement is running.
        """
        return self._client.call(refinement.start(self.name, iterations))

    def refinement_events(self) -> Iterator[JobStatus]:
        """The present or the last refinement whenever it has moved, until it has ended.

        Raises:
            NotFoundError: the session was never refined.
        """
        is_running, path = True, refinement.events_path(self.name)
        while is_running:
            try:
                for job in filter(None, map(refinement.job_in, self._client.lines(path))):
                    is_running = job.is_running
                    yield job
            except UnavailableError:
                time.sleep(POLL_S)  # the stream broke; the call below says whether the gateway did
                is_running = self._client.call(refinement.status(self.name)).is_running

    def refinement(self) -> JobStatus:
        """The present or the last refinement."""
        return self._client.call(refinement.status(self.name))

    def interrupt(self) -> JobStatus:
        """End a refinement; a live map rests until the next frame."""
        return self._client.call(refinement.interrupt(self.name))

    def wait_until_mapped(self, progress: Progress | None = None) -> None:
        """Wait until the map has worked through every answered frame."""
        most = left = pending(self.info())
        while left > 0:
            time.sleep(POLL_S)
            left = pending(self.info())
            most = max(most, left)
            if progress is not None:
                progress(most - left, most)

    def save(self) -> dict[str, Any]:
        """Write a snapshot; returns when it is on disk."""
        return self._client.call(calls.save(self.name))

    def export(self, format: ExportFormat | str, path: Path | str) -> None:
        """The map as a file; see `ExportFormat`."""
        params = {"format": str(ExportFormat(format))}
        self._client.download(calls.export_path(self.name), params, Path(path))

    def delete(self) -> None:
        """Remove the session and every byte of it."""
        self._client.call(calls.delete(self.name))
