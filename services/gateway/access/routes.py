"""The scope that each route and each RPC needs. What is not named here is not served."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from starlette.routing import Mount, Route, WebSocketRoute, compile_path

from shared.api_keys import Scope


@dataclass(frozen=True)
class Access:
    """Any of these scopes opens the route; without any it is open to everybody.

    `takes_ticket`: a browser may show a ticket in the URL instead of a key in a header.
    """

    scopes: frozenset[Scope]
    takes_ticket: bool = False


OPEN = Access(frozenset())
ANY = Access(frozenset(Scope))
INGEST = Access(frozenset({Scope.INGEST}))
POSE = Access(frozenset({Scope.POSE}))
RENDER = Access(frozenset({Scope.RENDER}))
ADMIN = Access(frozenset({Scope.ADMIN}))

_SESSION = "/v1/sessions/{name}"

HTTP: dict[str, Access] = {
    "GET /healthz": OPEN,
    "GET /readyz": OPEN,
    "GET /docs": OPEN,
    "GET /openapi.json": OPEN,
    "GET /": OPEN,
    "GET /capture": OPEN,
    "GET /web/{name:path}": OPEN,
    "GET /metrics": ADMIN,
    "POST /v1/tickets": ANY,
    "GET /v1/sessions": ANY,
    "POST /v1/sessions": INGEST,
    f"GET {_SESSION}": ANY,
    f"DELETE {_SESSION}": ADMIN,
    f"PUT {_SESSION}/pin": ADMIN,
    f"DELETE {_SESSION}/pin": ADMIN,
    f"POST {_SESSION}/frames": INGEST,
    f"WS {_SESSION}/stream": Access(INGEST.scopes, takes_ticket=True),
    f"WS {_SESSION}/watch": Access(POSE.scopes, takes_ticket=True),
    f"POST {_SESSION}/localize": POSE,
    f"GET {_SESSION}/pose": POSE,
    f"GET {_SESSION}/pose/events": Access(POSE.scopes, takes_ticket=True),
    f"GET {_SESSION}/geopose": POSE,
    f"GET {_SESSION}/georeference": POSE,
    f"PUT {_SESSION}/georeference": ADMIN,
    f"GET {_SESSION}/trajectory": POSE,
    f"GET {_SESSION}/trajectory.{{format}}": POSE,
    f"GET {_SESSION}/path": POSE,
    f"GET {_SESSION}/keyframes": POSE,
    f"GET {_SESSION}/events": Access(POSE.scopes, takes_ticket=True),
    f"GET {_SESSION}/image": RENDER,
    f"GET {_SESSION}/keyframes/{{seq}}/image": RENDER,
    f"GET {_SESSION}/render": RENDER,
    f"POST {_SESSION}/renders": RENDER,
    f"GET {_SESSION}/renders/{{job}}": RENDER,
    f"DELETE {_SESSION}/renders/{{job}}": RENDER,
    f"GET {_SESSION}/renders/{{job}}/events": Access(RENDER.scopes, takes_ticket=True),
    f"GET {_SESSION}/renders/{{job}}/file": RENDER,
    f"WS {_SESSION}/view": Access(RENDER.scopes, takes_ticket=True),
    f"GET {_SESSION}/map.ply": RENDER,
    f"GET {_SESSION}/map": RENDER,
    f"POST {_SESSION}/refine": ADMIN,
    f"GET {_SESSION}/refine": ANY,
    f"DELETE {_SESSION}/refine": ADMIN,
    f"GET {_SESSION}/refine/events": Access(ANY.scopes, takes_ticket=True),
    f"POST {_SESSION}/save": ADMIN,
}

_RPC = "/pointslam.v1."

GRPC: dict[str, Access] = {
    f"{_RPC}SessionService/CreateSession": INGEST,
    f"{_RPC}SessionService/GetSession": ANY,
    f"{_RPC}SessionService/ListSessions": ANY,
    f"{_RPC}SessionService/DeleteSession": ADMIN,
    f"{_RPC}TrackingService/TrackFrames": INGEST,
    f"{_RPC}TrackingService/WatchFrames": POSE,
    f"{_RPC}TrackingService/Localize": POSE,
    f"{_RPC}PoseService/GetPose": POSE,
    f"{_RPC}PoseService/GetPoseAt": POSE,
    f"{_RPC}PoseService/WatchPoses": POSE,
    f"{_RPC}MapService/GetMapInfo": ANY,
    f"{_RPC}MapService/RenderView": RENDER,
    f"{_RPC}MapService/ExportMap": RENDER,
    "/grpc.health.v1.Health/Check": OPEN,
    "/grpc.health.v1.Health/List": OPEN,
    "/grpc.health.v1.Health/Watch": OPEN,
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": OPEN,
}

_PATTERNS = [
    (method, compile_path(path)[0], access)
    for method, path, access in ((*words.split(" ", 1), HTTP[words]) for words in HTTP)
]


def access_to(method: str, path: str) -> Access:
    """What a request needs; one to no route of ours needs a key before it is told so."""
    method = "GET" if method == "HEAD" else method
    for known, pattern, access in _PATTERNS:
        if known == method and pattern.match(path):
            return access
    return ANY


def names_of(routes: Iterable[Any]) -> Iterator[str]:
    """The routes of an application as the table spells them."""
    for route in routes:
        if isinstance(route, WebSocketRoute):
            yield f"WS {route.path}"
        elif isinstance(route, Mount):
            yield f"GET {route.path}/{{path:path}}"
        elif isinstance(route, Route):
            yield from (f"{method} {route.path}" for method in (route.methods or ()))
        else:  # FastAPI's own, around the routes of an included router
            yield from names_of(route.original_router.routes)


def require_table(routes: Iterable[Any]) -> None:
    """Let no application start that has a route without a scope."""
    names = {name for name in names_of(routes) if not name.startswith("HEAD ")}
    missing = sorted(names - HTTP.keys())
    assert not missing, f"routes without a scope in services/gateway/access/routes.py: {missing}"
