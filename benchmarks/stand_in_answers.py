"""What a stand-in's map says of itself: where on Earth it is, and a file of three pieces."""

from __future__ import annotations

from dataclasses import dataclass

from shared.bus import Bus, Keys
from shared.georeference import Georeference, GeoreferenceReply, GeoreferenceRequest
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
