"""What the gateway's settings promise together."""

from services.gateway.config import GatewayConfig


def test_a_gateway_that_is_asked_to_end_does_so_within_ten_seconds():
    assert GatewayConfig().ends_within_s <= 10.0
