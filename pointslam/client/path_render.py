"""The calls of a path render."""

from __future__ import annotations

import httpx

from pointslam.client.calls import Call, path_of
from shared import codec
from shared.errors import PointSlamError
from shared.maps import JobState
from shared.path_renders import PathRenderRequest, PathRenderStatus


def start(session: str, request: PathRenderRequest) -> Call[PathRenderStatus]:
    """Begin to draw."""
    return Call("POST", path_of(session, "/renders"), _status, json=codec.to_json(request))


def status(session: str, job: str) -> Call[PathRenderStatus]:
    """How far it is."""
    return Call("GET", path_of(session, f"/renders/{job}"), _status)


def cancel(session: str, job: str) -> Call[PathRenderStatus]:
    """End it, or let its file go."""
    return Call("DELETE", path_of(session, f"/renders/{job}"), _status)


def file_path(session: str, job: str) -> str:
    """Where its file is fetched."""
    return path_of(session, f"/renders/{job}/file")


def succeeded(status: PathRenderStatus) -> PathRenderStatus:
    """A path render that has ended.

    Raises:
        PointSlamError: it failed, or was cancelled.
    """
    if status.state is not JobState.DONE:
        raise PointSlamError(f"the path render ended {status.state}: {status.error or 'cancelled'}")
    return status


def _status(response: httpx.Response) -> PathRenderStatus:
    return codec.from_plain(PathRenderStatus, response.json())
