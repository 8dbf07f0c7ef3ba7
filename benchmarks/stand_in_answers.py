"""What stand-ins answer whatever happened before: a place on Earth, a file, where an image was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.bus import Bus, Keys
from shared.georeference import Georeference, GeoreferenceReply, GeoreferenceRequest
from shared.localization import LocalizationStatus, LocalizeRequest, LocalizeResult
from shared.maps import Empty, ExportChunk, ExportRequest, PinRequest


@dataclass
class Place:
    """Keeps what it is told."""

    georeference: Georeference | None = None

    def answer(self, request: GeoreferenceRequest) -> GeoreferenceReply:
        """Take a new one, if there is one; tells the present one."""
        self.georeference = request.new or self.georeference
        return GeoreferenceReply(self.georeference)


def export_piece(request: ExportRequest) -> ExportChunk:
    """The piece at an offset."""
    return ExportChunk(request.offset, 3000, bytes([request.offset // 1000]) * 1000, "1")


def serve_pins(bus: Bus, mapper: str) -> None:
    """Take pins: a stand-in deletes nothing by itself."""
    bus.serve(Keys.mapper(mapper, "pin"), PinRequest, lambda _: Empty())


def located(request: LocalizeRequest) -> LocalizeResult:
    """Where the prior says; without one it is not found."""
    prior = request.T_world_prior
    status = LocalizationStatus.COLOUR_ONLY
    if request.depth is not None:
        status = LocalizationStatus.LOCALISED
    return LocalizeResult(
        status=status if prior is not None else LocalizationStatus.NOT_LOCALISED,
        reason="" if prior is not None else "no keyframe looks like this",
        T_world_camera=prior if prior is not None else np.eye(4),
        covariance=1e-6 * np.eye(6),
        inliers=100,
        inlier_share=0.5,
        reference_seq=0,
        map_revision=request.map_revision,
        timings_ms={"decode": 1.0},
    )
