"""An OTLP collector of one page: says its port, then a JSON line for each span it is sent.

A process of its own: gRPC's server and the forks of a test that starts services do not go together.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import grpc
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import (
    ExportTraceServiceRequest,
    ExportTraceServiceResponse,
)
from opentelemetry.proto.collector.trace.v1.trace_service_pb2_grpc import (
    TraceServiceServicer,
    add_TraceServiceServicer_to_server,
)


def lines(request: ExportTraceServiceRequest) -> Iterator[str]:
    """Service, name and trace id of each span."""
    for resource in request.resource_spans:
        named = {item.key: item.value.string_value for item in resource.resource.attributes}
        for scope in resource.scope_spans:
            for span in scope.spans:
                yield json.dumps([named["service.name"], span.name, span.trace_id.hex()]) + "\n"


class Receiver(TraceServiceServicer):
    """Writes down whatever arrives."""

    def Export(
        self, request: ExportTraceServiceRequest, context: grpc.ServicerContext
    ) -> ExportTraceServiceResponse:
        sys.stdout.writelines(lines(request))
        sys.stdout.flush()
        return ExportTraceServiceResponse()


def main() -> None:
    server = grpc.server(ThreadPoolExecutor(max_workers=1))
    add_TraceServiceServicer_to_server(Receiver(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    sys.stdout.write(f"{port}\n")
    sys.stdout.flush()
    server.wait_for_termination()


if __name__ == "__main__":
    main()
