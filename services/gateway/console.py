"""The pages of `web/` (console, capture, API): files served as they are, without a build step."""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
import mimetypes
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import Response

from shared.errors import NotFoundError

WEB = Path(__file__).with_name("web")
_TYPES = {".js": "text/javascript", ".svg": "image/svg+xml", ".html": "text/html"}
_COMPRESSED = ("text/", "image/svg+xml")
_INLINE = re.compile(rb"<script[^>]*>(.+?)</script>", re.DOTALL)


@dataclass(frozen=True)
class WebFile:
    """A file, compressed where that helps, and what a browser must know of it."""

    content: bytes
    packed: bytes | None
    headers: dict[str, str]

    def response(self, request: Request) -> Response:
        """The file, packed if the client unpacks; 304 where it has it."""
        if self.headers["ETag"] in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=self.headers)
        if self.packed is None or "gzip" not in request.headers.get("accept-encoding", ""):
            return Response(self.content, headers=self.headers)
        return Response(self.packed, headers=self.headers | {"Content-Encoding": "gzip"})


@cache
def web_file(name: str) -> WebFile:
    """A file of `web/`, read and compressed once.

    Raises:
        NotFoundError: there is no such file.
    """
    path = (WEB / name).resolve()
    if not path.is_relative_to(WEB) or not path.is_file():
        raise NotFoundError(f"no page {name[:100]}")
    content = path.read_bytes()
    kind = _TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "text/plain"
    headers = {
        "Content-Type": f"{kind}; charset=utf-8" if kind.startswith("text/") else kind,
        "ETag": f'"{hashlib.blake2b(content, digest_size=12).hexdigest()}"',
        "Cache-Control": "no-cache",  # asked for each time, sent when it has changed
        "Vary": "Accept-Encoding",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
    }
    if path.suffix == ".html":
        headers["Content-Security-Policy"] = content_security_policy(content)
    packed = gzip.compress(content, mtime=0) if kind.startswith(_COMPRESSED) else None
    return WebFile(content, packed, headers)


def content_security_policy(page: bytes) -> str:
    """Nothing from elsewhere; of inline scripts only those of the page (its import map).

    The splat viewer starts its workers from blobs and compiles WebAssembly that it holds as data.
    """
    digests = [base64.b64encode(hashlib.sha256(s).digest()).decode() for s in _INLINE.findall(page)]
    scripts = " ".join(f"'sha256-{digest}'" for digest in digests)
    return "; ".join(
        [
            "default-src 'self'",
            f"script-src 'self' 'wasm-unsafe-eval' blob: {scripts}",
            "worker-src 'self' blob:",
            "connect-src 'self' data: blob:",
            "img-src 'self' data: blob:",
            "style-src 'self' 'unsafe-inline'",
            "frame-ancestors 'none'",
            "base-uri 'none'",
        ]
    )


def console_routes() -> APIRouter:
    """The pages and what they load; open to everyone, since they hold nothing of a session."""
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    async def console(request: Request) -> Response:
        return await _respond("index.html", request)

    @router.get("/capture")
    async def capture(request: Request) -> Response:
        return await _respond("capture.html", request)

    @router.get("/docs")
    async def docs(request: Request) -> Response:
        return await _respond("docs.html", request)

    @router.get("/web/{name:path}")
    async def file(name: str, request: Request) -> Response:
        return await _respond(name, request)

    return router


async def _respond(name: str, request: Request) -> Response:
    # Compressing the largest takes 0.1 s once; frames go on meanwhile.
    return (await asyncio.to_thread(web_file, name)).response(request)
