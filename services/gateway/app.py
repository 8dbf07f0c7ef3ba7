"""The gateway's application: sessions on the bus, served over HTTP and WebSocket."""

from __future__ import annotations

from fastapi import FastAPI

from services.gateway.access.authority import Authority
from services.gateway.access.http_guard import HttpGuard
from services.gateway.access.routes import require_table
from services.gateway.body_limit import BodyLimit
from services.gateway.config import GatewayConfig
from services.gateway.console import console_routes
from services.gateway.dispatch import TrackerPool
from services.gateway.geo_http import geo_routes
from services.gateway.http import http_routes
from services.gateway.job_http import job_routes
from services.gateway.live_http import live_routes
from services.gateway.map_http import map_routes
from services.gateway.members import Members
from services.gateway.metrics import metrics_routes
from services.gateway.owner import Fabric
from services.gateway.path_renders.routes import path_render_routes
from services.gateway.pose_http import pose_routes
from services.gateway.problems import add_handlers
from services.gateway.sessions import Sessions
from services.gateway.ticket_http import ticket_routes
from services.gateway.view_socket import view_routes
from services.gateway.websocket import websocket_routes
from shared.bus import Bus

_DESCRIPTION = """RGB-D frames in, camera poses and views of a neural-Gaussian map out.

Poses are `T_map_camera`: camera to map, metres, named quaternion fields, OpenCV axes (x right,
y down, z forward). Times are nanoseconds of the client's clock. Errors are problem documents
(RFC 9457) with `code`, `field` and `reason`. Frames stream over the WebSocket
`/v1/sessions/{name}/stream` as the msgpack messages that `POST .../frames` takes.

Send a key as `Authorization: Bearer ps_...`, made by `pointslam keys create`; it belongs to a
tenant, whose sessions are all that it can see. A browser's sockets and event streams take
`?ticket=` from `POST /v1/tickets` instead. 401 is no valid key, 403 a key without the scope, 429
too much at once (see Retry-After)."""


def open_sessions(bus: Bus, config: GatewayConfig, name: str = "gateway") -> Sessions:
    """The sessions of a gateway on this bus; call it on the event loop."""
    trackers = TrackerPool(bus, Members(bus, "tracking"), config.dispatch)
    sessions = Sessions(Fabric(bus, trackers, Members(bus, "mapping"), config, name))
    sessions.measure()
    return sessions


def create_app(sessions: Sessions, authority: Authority) -> FastAPI:
    """The HTTP and WebSocket side, open to whom the authority admits."""

    app = FastAPI(
        title="PointSLAM++",
        version="1",
        description=_DESCRIPTION,
        docs_url=None,  # a page of our own, since FastAPI's loads scripts from elsewhere
        redoc_url=None,
    )
    for routes in (http_routes, live_routes, map_routes, job_routes, websocket_routes, view_routes):
        app.include_router(routes(sessions))
    app.include_router(pose_routes(sessions))
    app.include_router(geo_routes(sessions))
    app.include_router(path_render_routes(sessions))
    app.include_router(ticket_routes(authority))
    app.include_router(metrics_routes())
    app.include_router(console_routes())
    require_table(app.routes)
    _describe_keys(app)
    add_handlers(app)
    app.add_middleware(BodyLimit, max_bytes=sessions.fabric.config.limits.max_message_bytes)
    app.add_middleware(HttpGuard, authority=authority)
    return app


def _describe_keys(app: FastAPI) -> None:
    """Say in the OpenAPI how a key is sent, which the guard asks for before any route."""
    schema = app.openapi()  # made once and kept
    schema["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
    schema["security"] = [{"key": []}, {}]  # none with --insecure-local
