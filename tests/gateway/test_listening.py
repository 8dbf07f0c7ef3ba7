"""Where a gateway listens."""

import socket

import pytest

from services.gateway.__main__ import listen
from shared.errors import UnavailableError


def _has_ipv6() -> bool:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False


needs_ipv6 = pytest.mark.skipif(not _has_ipv6(), reason="this machine has no IPv6")


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("::1", marks=needs_ipv6)])
def test_it_listens_at_the_loopback_address_of_either_kind(host):
    with listen(host, 0, 5.0) as listener:
        socket.create_connection(listener.getsockname()[:2], timeout=5.0).close()


def test_an_address_in_use_is_named():
    with (
        listen("127.0.0.1", 0, 5.0) as listener,
        pytest.raises(UnavailableError, match=f"127.0.0.1:{listener.getsockname()[1]}"),
    ):
        listen("127.0.0.1", listener.getsockname()[1], 5.0)
