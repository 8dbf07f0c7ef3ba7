"""Questions to the owner of a map that both doors ask: views, and the map as a file."""

from __future__ import annotations

from collections.abc import AsyncIterator

from services.gateway.config import GatewayConfig
from services.gateway.session import Session
from shared.errors import UnavailableError
from shared.maps import (
    Empty,
    ExportChunk,
    ExportFormat,
    ExportRequest,
    MapInfo,
    RenderReply,
    RenderRequest,
)


async def map_state(session: Session, config: GatewayConfig) -> str:
    """What changes whenever a view of the map may: its owner, its keyframes, its optimisation.

    Ask before rendering: a tag that is older than the view costs one more transfer, a newer one
    would hide a change.
    """
    timeout_s = config.mapping.question_timeout_s
    info: MapInfo = await session.owner.ask("info", Empty(), MapInfo, timeout_s)
    return f"{info.epoch}.{info.map_revision}.{info.iterations}"


async def ask_render(
    session: Session, request: RenderRequest, config: GatewayConfig
) -> RenderReply:
    """A view drawn by the owner of the session's map."""
    timeout_s = config.mapping.question_timeout_s
    return await session.owner.ask("render", request, RenderReply, timeout_s)


async def export_pieces(
    session: Session, format: ExportFormat, config: GatewayConfig
) -> AsyncIterator[ExportChunk]:
    """The file in pieces, checked to be in order and complete.

    Raises:
        UnavailableError: the owner went away before the end.
    """
    await session.flush(config.mapping.question_timeout_s)
    timeout_s = config.mapping.export_timeout_s
    at = total = 0
    request = ExportRequest(format)
    async for piece in session.owner.pieces("export", request, ExportChunk, timeout_s):
        if piece.offset != at:
            raise UnavailableError(f"the export broke off at byte {at}")
        at, total = at + len(piece.bytes), piece.total
        yield piece
    if at != total:
        raise UnavailableError(f"the export ended at byte {at} of {total}")
