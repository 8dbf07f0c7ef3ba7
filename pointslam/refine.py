"""Refinement of a session that a gateway serves, with a bar that shows how far it is."""

from __future__ import annotations

from pointslam.client import Client, Session
from pointslam.client.refinement import succeeded
from pointslam.progress import open_bar
from shared.maps import JobStatus


def refine_session(gateway: str, session: str, iterations: int) -> JobStatus:
    """Refine a session, or with 0 iterations watch the refinement that is under way.

    Raises:
        ConflictError: a refinement is running.
        PointSlamError: there is no such session, or the refinement failed.
    """
    with Client(gateway) as client:
        opened = client.session(session)
        if iterations > 0:
            opened.start_refinement(iterations)
        return watch_refinement(opened)


def interrupt_session(gateway: str, session: str) -> JobStatus:
    """End the refinement of a session."""
    with Client(gateway) as client:
        return client.session(session).interrupt()


def watch_refinement(session: Session) -> JobStatus:
    """Show a refinement until it has ended.

    Raises:
        PointSlamError: it failed.
    """
    job = JobStatus()
    with open_bar("refinement", "it") as bar:
        for job in session.refinement_events():
            bar.total = job.iterations_total
            if job.psnr_db is not None:
                bar.set_postfix_str(f"{job.psnr_db:.2f} dB", refresh=False)
            bar.update(job.iterations_done - bar.n)
    return succeeded(job)
