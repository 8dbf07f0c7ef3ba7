"""Owners of maps that die, in the middle of a snapshot too, or freeze past their lease."""

import threading
import time

import pytest

from benchmarks.cluster import wait_for
from pointslam.client import Client
from shared.errors import PointSlamError

pytestmark = pytest.mark.system


def owner_of(cluster, name):
    with Client(cluster.url) as client:
        return client.session(name).info()["mapper"]


def save(cluster, name):
    """Asks for a snapshot whose owner will not live to answer."""
    with Client(cluster.url) as client:
        try:
            client.session(name).save()
        except PointSlamError:
            return


def test_a_mapper_killed_twice_once_in_a_snapshot_loses_no_keyframe(
    cluster, streaming, moment_s, data_folder
):
    with streaming() as players:
        name = next(iter(players))
        time.sleep(moment_s)
        first = owner_of(cluster, name)
        saving = threading.Thread(target=save, args=(cluster, name), daemon=True)
        saving.start()
        wait_for(lambda: any((data_folder / name).glob("snapshot-*.tmp")))
        cluster.kill(first)
        cluster.start(first)
        second = owner_of(cluster, name)
        cluster.kill(second)
        cluster.start(second)
        saving.join(60.0)

    assert not saving.is_alive()


def test_a_mapper_frozen_past_its_lease_is_succeeded_and_steps_down(cluster, streaming, moment_s):
    with streaming() as players:
        name = next(iter(players))
        time.sleep(moment_s)
        frozen = owner_of(cluster, name)
        cluster.freeze(frozen)
        wait_for(lambda: owner_of(cluster, name) != frozen)
        cluster.wake(frozen)

        log = cluster.process(frozen).log
        wait_for(lambda: "is over" in log.read_text())
