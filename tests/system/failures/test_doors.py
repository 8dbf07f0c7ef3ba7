"""The gateway and the router between everything die and come back."""

import time

import pytest

pytestmark = pytest.mark.system


def test_a_router_that_starts_again_costs_no_frame(cluster, streaming, moment_s):
    with streaming():
        time.sleep(moment_s)
        cluster.kill("router")
        cluster.start("router")


def test_clients_reconnect_to_a_gateway_that_was_killed_and_go_on(cluster, streaming, moment_s):
    with streaming() as players:
        time.sleep(moment_s)
        cluster.kill("gateway-0")
        cluster.start("gateway-0")

    assert [player.heard.breaks for player in players.values()] == [1, 1, 1]
