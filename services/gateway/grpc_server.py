"""The gRPC server: our services, health and reflection."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from services.gateway.access.arguments import Tls
from services.gateway.access.authority import Authority
from services.gateway.access.grpc_guard import GrpcGuard
from services.gateway.grpc_services import (
    MapService,
    PoseService,
    SessionService,
)
from services.gateway.grpc_tracking import TrackingService
from services.gateway.sessions import Sessions
from shared.addresses import host_port
from shared.errors import UnavailableError
from shared.wire import (
    map_service_pb2,
    map_service_pb2_grpc,
    pose_service_pb2,
    pose_service_pb2_grpc,
    session_service_pb2,
    session_service_pb2_grpc,
    tracking_service_pb2,
    tracking_service_pb2_grpc,
)

_READINESS_S = 0.5
_NAMES = [
    module.DESCRIPTOR.services_by_name[name].full_name
    for module, name in (
        (session_service_pb2, "SessionService"),
        (tracking_service_pb2, "TrackingService"),
        (pose_service_pb2, "PoseService"),
        (map_service_pb2, "MapService"),
    )
]


@dataclass(frozen=True)
class GrpcDoor:
    """Where gRPC is served, to whom, and with which certificate."""

    host: str
    port: int
    authority: Authority
    tls: Tls | None = None

    def listen(self, server: grpc.aio.Server) -> None:
        """Add the port to the server.

        Raises:
            UnavailableError: it cannot be listened on.
        """
        address = host_port(self.host, self.port)
        try:
            if self.tls is None:
                server.add_insecure_port(address)
                return
            pair = (self.tls.key.read_bytes(), self.tls.certificate.read_bytes())
            server.add_secure_port(address, grpc.ssl_server_credentials([pair]))
        except (RuntimeError, OSError) as error:
            raise UnavailableError(f"cannot listen on {address}: {error}") from None


@asynccontextmanager
async def serve_grpc(sessions: Sessions, door: GrpcDoor) -> AsyncIterator[None]:
    """Serve while the block runs; then finish the calls in flight.

    Raises:
        UnavailableError: the port cannot be listened on.
    """
    server = grpc.aio.server(
        interceptors=[GrpcGuard(door.authority)],
        options=_options(sessions.fabric.config.limits.max_message_bytes),
    )
    # The module exposes it by an import that type checkers take for private.
    healthy = health.aio.HealthServicer()  # pyright: ignore[reportAttributeAccessIssue]
    health_pb2_grpc.add_HealthServicer_to_server(healthy, server)
    _add_services(sessions, server)
    reflection.enable_server_reflection(
        [*_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME], server
    )
    door.listen(server)
    await server.start()
    readiness = asyncio.create_task(_follow_readiness(sessions, healthy))
    try:
        yield
    finally:
        readiness.cancel()
        await healthy.enter_graceful_shutdown()
        await server.stop(sessions.fabric.config.drain_calls_s)


def _options(max_message_bytes: int) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", -1),
        ("grpc.so_reuseport", 0),  # a taken port is an error
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", 5000),
    ]


def _add_services(sessions: Sessions, server: grpc.aio.Server) -> None:
    session_service_pb2_grpc.add_SessionServiceServicer_to_server(SessionService(sessions), server)
    tracking_service_pb2_grpc.add_TrackingServiceServicer_to_server(
        TrackingService(sessions), server
    )
    pose_service_pb2_grpc.add_PoseServiceServicer_to_server(PoseService(sessions), server)
    map_service_pb2_grpc.add_MapServiceServicer_to_server(MapService(sessions), server)


async def _follow_readiness(sessions: Sessions, healthy: Any) -> None:
    """Tell by the health service whether sessions can be created and tracked."""
    status = health_pb2.HealthCheckResponse
    while True:
        now = status.SERVING if sessions.is_ready() else status.NOT_SERVING
        for name in ("", *_NAMES):
            await healthy.set(name, now)
        await asyncio.sleep(_READINESS_S)
