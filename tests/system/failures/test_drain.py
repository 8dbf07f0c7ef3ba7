"""A deploy in the middle of a session: each service is asked to end and started again."""

import signal
import threading
import time

import httpx
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import free_port, gateway_process, local_gateway
from pointslam.client import Client

pytestmark = pytest.mark.system


def owner_of(cluster, name):
    with Client(cluster.url) as client:
        return client.session(name).info()["mapper"]


def test_a_tracker_that_is_asked_to_end_costs_nothing(cluster, streaming, moment_s):
    with streaming():
        time.sleep(moment_s)
        code = cluster.end("tracker-0")
        cluster.start("tracker-0")

    assert code == 0


def test_a_mapper_that_is_asked_to_end_saves_its_maps_and_lets_others_have_them(
    cluster, streaming, moment_s, data_folder
):
    with streaming() as players:
        name = next(iter(players))
        time.sleep(moment_s)
        owner = owner_of(cluster, name)
        code = cluster.end(owner)
        is_saved = any((data_folder / name).glob("snapshot-*"))
        next_owner = owner_of(cluster, name)
        cluster.start(owner)

    assert code == 0
    assert is_saved
    assert next_owner != owner


def test_a_gateway_that_is_asked_to_end_has_delivered_all(cluster, streaming, moment_s):
    with streaming() as players:
        time.sleep(moment_s)
        code = cluster.end("gateway-0")
        cluster.start("gateway-0")

    assert code == 0
    assert [player.heard.breaks for player in players.values()] == [1, 1, 1]


def watch(url, path):
    with httpx.stream("GET", url + path, timeout=60.0) as response:
        for _ in response.iter_bytes():
            pass


def test_a_gateway_is_ready_no_longer_before_its_door_closes_and_no_watcher_holds_it(
    recording,
):
    with local_gateway() as other:
        ports = (free_port(), free_port())
        settings = ("drain_notice_s=10.0",)
        with gateway_process(other.router, ports, *settings) as process:
            url = f"http://127.0.0.1:{ports[0]}"
            with Client(url) as client:
                wait_for(client.ready)
                name = client.create_session(recording.calibration, mode="live").name
            paths = [f"/v1/sessions/{name}/events", f"/v1/sessions/{name}/pose/events"]
            watching = [threading.Thread(target=watch, args=(url, path)) for path in paths]
            for thread in watching:
                thread.start()

            process.send_signal(signal.SIGTERM)
            wait_for(lambda: httpx.get(f"{url}/readyz").status_code == 503)
            for thread in watching:
                thread.join(60.0)

            assert process.wait(60.0) == 0
