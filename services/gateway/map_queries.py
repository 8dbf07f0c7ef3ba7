"""Questions to the owner of a map that both doors ask: views, and the map as a file."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import replace

from services.gateway.config import GatewayConfig
from services.gateway.session import Session
from shared.errors import NotFoundError, UnavailableError
from shared.maps import (
    ExportChunk,
    ExportFormat,
    ExportRequest,
    RenderReply,
    RenderRequest,
)


async def ask_render(
    session: Session, request: RenderRequest, config: GatewayConfig
) -> RenderReply:
    """A view drawn by the owner of the session's map."""
    timeout_s = config.mapping.question_timeout_s
    return await session.owner.ask("render", request, RenderReply, timeout_s)


async def export_pieces(
    session: Session, format: ExportFormat, config: GatewayConfig
) -> AsyncIterator[ExportChunk]:
    """The file in pieces; each is asked for when the one before it has been taken.

    Raises:
        UnavailableError: the owner, and the file with it, went away before the end.
    """
    await session.flush(config.mapping.question_timeout_s)
    timeout_s = config.mapping.export_timeout_s
    request, at, total = ExportRequest(format), 0, 1
    while at < total:
        try:
            piece: ExportChunk = await session.owner.ask("export", request, ExportChunk, timeout_s)
        except NotFoundError:
            raise UnavailableError(f"the export broke off at byte {at} of {total}") from None
        at, total = at + len(piece.bytes), piece.total
        yield piece
        request = replace(request, export=piece.export, offset=at)
