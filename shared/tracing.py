"""What a frame is called on its way through the services: fields of log lines, spans of a trace.

The client's W3C `traceparent` goes with each frame through the gateway's queue, and as an
attachment through zenoh to the workers and the map's owner. Without an exporter spans cost nothing
and only the trace's id travels, for the logs. `opentelemetry-sdk` is wanted for `--traces` alone.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import Any

from opentelemetry import context, trace
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from shared.errors import ConfigError

_HEADER = "traceparent"
_PROPAGATOR = TraceContextTextMapPropagator()
_TRACER = trace.get_tracer("pointslam")
_FIELDS: ContextVar[Mapping[str, object]] = ContextVar("log_fields", default=MappingProxyType({}))


@contextmanager
def log_fields(**fields: object) -> Iterator[None]:
    """Say in every log line of the block what it is about: session, seq, epoch."""
    token = _FIELDS.set({**_FIELDS.get(), **fields})
    try:
        yield
    finally:
        _FIELDS.reset(token)


def present_fields() -> dict[str, object]:
    """The fields of a log line here and now, with the trace's id where there is one."""
    found = trace.get_current_span().get_span_context()
    traced = {"trace_id": trace.format_trace_id(found.trace_id)} if found.is_valid else {}
    return {**_FIELDS.get(), **traced}


@contextmanager
def span(name: str, traceparent: str = "", **attributes: str | int) -> Iterator[None]:
    """A span around the block, below the sender's or else below the present one."""
    with under(traceparent):
        opened = _TRACER.start_span(name, attributes=attributes)
        with trace.use_span(opened, end_on_exit=True):
            yield


@contextmanager
def under(traceparent: str) -> Iterator[None]:
    """Make a sender's span the present one; one that is no W3C traceparent changes nothing."""
    if not traceparent:
        yield
        return
    token = context.attach(_PROPAGATOR.extract({_HEADER: traceparent}))
    try:
        yield
    finally:
        context.detach(token)


def outgoing() -> str:
    """The present span as a `traceparent`; empty where there is none."""
    carrier: dict[str, str] = {}
    _PROPAGATOR.inject(carrier)
    return carrier.get(_HEADER, "")


def add_tracing_arguments(parser: argparse.ArgumentParser) -> None:
    """Where spans go; nowhere unless said."""
    parser.add_argument(
        "--traces",
        default="",
        metavar="TARGET",
        help="OTLP collector (http://host:4317), or file:FOLDER for JSON lines; off without",
    )
    parser.add_argument(
        "--trace-share",
        type=float,
        default=0.01,
        metavar="SHARE",
        help="of the frames whose sender has not decided itself, by its traceparent",
    )


def setup_tracing(role: str, arguments: argparse.Namespace) -> None:
    """Send this process's spans where its arguments say.

    Raises:
        ConfigError: the SDK or its exporter is not installed, or the target is none.
    """
    if not arguments.traces:
        return
    try:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased

        processor = _processor(arguments.traces, role)
    except ImportError as error:
        raise ConfigError(f"--traces: pip install 'pointslam[tracing]' ({error})") from None
    if not 0.0 <= arguments.trace_share <= 1.0:
        raise ConfigError(f"--trace-share must be 0 to 1, got {arguments.trace_share}")
    named = {"service.name": f"pointslam-{role}", "service.instance.id": arguments.id}
    sampler = ParentBased(TraceIdRatioBased(arguments.trace_share))
    provider = TracerProvider(resource=Resource.create(named), sampler=sampler)
    provider.add_span_processor(processor)
    trace.set_tracer_provider(provider)


def _processor(target: str, role: str) -> Any:
    from opentelemetry.sdk.trace.export import (
        BatchSpanProcessor,
        ConsoleSpanExporter,
        SimpleSpanProcessor,
    )

    if target.startswith("file:"):
        folder = Path(target.removeprefix("file:"))
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / f"{role}-{os.getpid()}.jsonl").open("a", buffering=1)
        line = ConsoleSpanExporter(out=file, formatter=lambda span: span.to_json(None) + "\n")
        return SimpleSpanProcessor(line)
    if not target.startswith(("http://", "https://")):
        raise ConfigError(f"--traces must be http(s)://host:port or file:FOLDER, got {target!r}")
    from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter

    return BatchSpanProcessor(OTLPSpanExporter(target, insecure=target.startswith("http://")))
