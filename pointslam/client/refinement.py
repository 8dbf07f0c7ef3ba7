"""The calls of a refinement, and its events."""

from __future__ import annotations

import json

import httpx

from pointslam.client.calls import Call, path_of
from shared import codec
from shared.errors import PointSlamError
from shared.maps import JobState, JobStatus


def start(session: str, iterations: int) -> Call[JobStatus]:
    """Start a refinement."""
    return Call("POST", path_of(session, "/refine"), _job, json={"iterations": iterations})


def status(session: str) -> Call[JobStatus]:
    """The present or the last refinement."""
    return Call("GET", path_of(session, "/refine"), _job)


def interrupt(session: str) -> Call[JobStatus]:
    """Stop a refinement."""
    return Call("DELETE", path_of(session, "/refine"), _job)


def events_path(session: str) -> str:
    """Where a refinement tells how far it is."""
    return path_of(session, "/refine/events")


def job_in(line: str) -> JobStatus | None:
    """What a line of the event stream says of a refinement; None for one that says nothing."""
    if not line.startswith("data:"):
        return None
    return codec.from_plain(JobStatus, json.loads(line.removeprefix("data:")))


def succeeded(job: JobStatus) -> JobStatus:
    """A refinement that has ended.

    Raises:
        PointSlamError: it failed.
    """
    if job.state is JobState.FAILED:
        raise PointSlamError(f"the refinement failed: {job.error}")
    return job


def _job(response: httpx.Response) -> JobStatus:
    return codec.from_plain(JobStatus, response.json())
