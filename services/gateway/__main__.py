"""Gateway: clients' frames in over HTTP, WebSocket and gRPC; poses and views out."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import sys
from collections.abc import Iterator

import uvicorn
from fastapi import FastAPI

from services.gateway.access.arguments import (
    Tls,
    add_access_arguments,
    authority_from,
    tls_from,
)
from services.gateway.app import create_app, open_sessions
from services.gateway.config import GatewayConfig
from services.gateway.grpc_server import GrpcDoor, serve_grpc
from services.gateway.sessions import Sessions
from shared.addresses import host_port
from shared.bus import Bus, open_bus
from shared.errors import UnavailableError
from shared.service import (
    announce_ready,
    endpoints,
    limit_blas_threads,
    run_service,
    service_arguments,
    settings_from,
    setup_logging,
)
from shared.tracing import setup_tracing


class _Server(uvicorn.Server):
    """uvicorn without its own signal handling, which would end the process by the signal."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        announce_ready("gateway")


def main(argv: list[str]) -> None:
    """Read settings, connect, serve until SIGTERM."""
    parser = service_arguments(__doc__)
    parser.add_argument("--http-host", default="127.0.0.1", help="address of HTTP and gRPC")
    parser.add_argument("--http-port", type=int, default=8080)
    parser.add_argument("--grpc-port", type=int, default=50051)
    add_access_arguments(parser)
    arguments = parser.parse_args(argv)
    limit_blas_threads()
    setup_logging(arguments.json_log)
    setup_tracing("gateway", arguments)
    config = settings_from(arguments, GatewayConfig())
    authority, tls = authority_from(arguments, config.access), tls_from(arguments)
    door = GrpcDoor(arguments.http_host, arguments.grpc_port, authority, tls)
    listener = listen(arguments.http_host, arguments.http_port, config.stream.unread_s)
    with listener, open_bus(endpoints(arguments), config.bus) as bus:
        loop_factory = uvicorn.Config(lambda: None).get_loop_factory()
        with asyncio.Runner(loop_factory=loop_factory) as runner:
            runner.run(_serve(bus, config, listener, door, arguments.id))


def listen(host: str, port: int, unread_s: float) -> socket.socket:
    """A socket that connections come to, whose dead ones end after `unread_s`.

    Raises:
        UnavailableError: it cannot be listened on.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    is_both = host == "::" and socket.has_dualstack_ipv6()  # as gRPC does
    try:
        listener = socket.create_server(
            (host, port), family=family, backlog=512, dualstack_ipv6=is_both
        )
    except OSError as error:
        raise UnavailableError(f"cannot listen on {host_port(host, port)}: {error}") from None
    # Connections inherit it.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1e3 * unread_s))
    return listener


async def _serve(
    bus: Bus, config: GatewayConfig, listener: socket.socket, door: GrpcDoor, name: str
) -> None:
    sessions = open_sessions(bus, config, name)
    forgetting = asyncio.create_task(sessions.forget_idle())
    server = _Server(_uvicorn_config(create_app(sessions, door.authority), config, door.tls))
    asked_to_end = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, asked_to_end.set)
    draining = asyncio.create_task(_drain(asked_to_end, sessions, server))
    try:
        async with serve_grpc(sessions, door):
            await server.serve([listener])
    finally:
        forgetting.cancel()
        draining.cancel()
        await sessions.close()


async def _drain(asked_to_end: asyncio.Event, sessions: Sessions, server: _Server) -> None:
    """Be ready no longer, let streams go with all their replies, then close the door."""
    await asked_to_end.wait()
    sessions.drain()
    config = sessions.fabric.config
    await asyncio.sleep(config.drain_notice_s)
    # The server would cut them off in the middle.
    await sessions.fabric.streams.finish(config.drain_streams_s)
    server.should_exit = True


def _uvicorn_config(app: FastAPI, config: GatewayConfig, tls: Tls | None) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        ssl_certfile=tls.certificate if tls else None,
        ssl_keyfile=tls.key if tls else None,
        log_config=None,
        log_level="warning",
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=config.limits.max_message_bytes,
        ws_per_message_deflate=False,
        ws_ping_interval=config.stream.ping_interval_s,
        ws_ping_timeout=config.stream.ping_timeout_s,
        limit_concurrency=config.limits.max_connections,
        timeout_graceful_shutdown=max(1, round(config.drain_s)),
    )


if __name__ == "__main__":
    sys.exit(run_service(main, sys.argv[1:]))
