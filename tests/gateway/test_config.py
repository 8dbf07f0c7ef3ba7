"""What the gateway's settings promise together."""

import pytest

from services.gateway.config import GatewayConfig
from shared.config import override, read_overrides
from shared.errors import ConfigError


def test_a_gateway_that_is_asked_to_end_does_so_within_ten_seconds():
    assert GatewayConfig().ends_within_s <= 10.0


@pytest.mark.parametrize(
    "name", ["session_idle_s", "stream.live_interval_s", "stream.ping_interval_s", "path_keep_s"]
)
def test_an_interval_of_nothing_is_refused_by_name(name):
    with pytest.raises(ConfigError, match=name.rpartition(".")[2]):
        override(GatewayConfig(), read_overrides(None, [f"{name}=0"]))
