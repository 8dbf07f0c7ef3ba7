"""Requests that schemathesis makes of a gateway's OpenAPI: good ones, and some that break it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from schemathesis.core.result import Ok

_ENDLESS = "/events"  # streams that end with their session
_WAIT_S = 60.0
_UNHEALTHY = (HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large)


@schemathesis.serializer("application/msgpack")
def _as_it_is(_: schemathesis.SerializationContext, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


def send_cases(
    url: str, session: str, inputs: int, count: Callable[[int, str], None], start: int = 0
) -> None:
    """About so many requests, spread evenly over all operations; each answer's status is counted.

    Those that delete nothing are about a session that exists.
    """
    operations = list(_operations(url))
    for operation in operations:

        @seed(start)
        @settings(
            max_examples=max(inputs // len(operations), 1),
            deadline=None,
            database=None,
            phases=(Phase.explicit, Phase.generate),
            suppress_health_check=_UNHEALTHY,
        )
        @given(case=operation.as_strategy())
        def send(case: schemathesis.Case) -> None:
            if case.method != "DELETE" and "name" in case.path_parameters:
                case.path_parameters["name"] = session
            status = case.call(base_url=url, timeout=_WAIT_S).status_code
            count(status, f"{case.method} {case.formatted_path} {case.query} {case.body}")

        send()


def _operations(url: str) -> Iterator[schemathesis.APIOperation]:
    schema = schemathesis.openapi.from_url(f"{url}/openapi.json")
    for found in schema.get_all_operations():
        assert isinstance(found, Ok), found
        if not found.ok().path.endswith(_ENDLESS):
            yield found.ok()
