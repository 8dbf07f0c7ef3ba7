"""What the gateway counts."""

from __future__ import annotations

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from shared.metrics import counter, gauge, seconds

FRAMES = counter("frames", "Frames by outcome: a tracking status, or refused", "outcome")
FRAME_SECONDS = seconds("frame_seconds", "Time of a frame in the gateway: queue, total", "stage")
RETRIES = counter("tracker_retries", "Frames asked again of another worker: gone, timeout", "why")
QUARANTINES = counter("tracker_quarantines", "Workers left alone for a while")
TAKEOVERS = counter("map_takeovers", "Maps found again in a new epoch")


QUEUE_AGE = gauge("queue_age_seconds", "Age of the oldest frame that is not answered yet")
SESSIONS = gauge("open_sessions", "Sessions that this gateway holds")
UNDELIVERED = gauge("undelivered_frames", "Answered frames that no map has acknowledged yet")


def metrics_routes() -> APIRouter:
    """The page that Prometheus reads."""
    router = APIRouter(tags=["health"])

    @router.get("/metrics", response_class=Response, include_in_schema=False)
    async def metrics() -> Response:
        return Response(generate_latest(), media_type=CONTENT_TYPE_LATEST)

    return router
