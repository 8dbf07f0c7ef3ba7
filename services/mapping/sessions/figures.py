"""What a map amounts to, in numbers."""

from __future__ import annotations

from dataclasses import dataclass

from services.mapping.pipeline import Mapper


@dataclass(frozen=True)
class MapFigures:
    """What a map amounts to, in numbers."""

    anchors: int
    primary: int
    iterations: int
    psnr_db: float | None
    num_bytes: int  # anchors and networks, without optimizer state

    @staticmethod
    def of(mapper: Mapper) -> MapFigures:
        """The figures of a mapper at this moment."""
        return MapFigures(
            anchors=len(mapper.anchors),
            primary=mapper.anchors.num_primary,
            iterations=mapper.iterations,
            psnr_db=mapper.psnr_db,
            num_bytes=mapper.anchors.num_bytes + mapper.decoder.num_bytes,
        )
