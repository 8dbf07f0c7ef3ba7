"""What a tracking worker counts."""

from __future__ import annotations

from shared.metrics import counter, observe_stages, seconds
from shared.tracks import TrackResult

FRAMES = counter("tracked_frames", "Frames by tracking status", "status")
KEYFRAMES = counter("proposed_keyframes", "Frames that became keyframes")
STAGE_SECONDS = seconds("tracking_stage_seconds", "Time of a frame by stage", "stage")


def count(result: TrackResult) -> None:
    """Count one answered frame."""
    FRAMES.labels(str(result.status)).inc()
    KEYFRAMES.inc(result.keyframe is not None)
    observe_stages(STAGE_SECONDS, result.timings_ms)
