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


def save(cluster, name, is_killed):
    """Asks for one snapshot after the other, until their owner did not live to answer."""
    with Client(cluster.url) as client:
        while not is_killed.is_set():
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
        is_killed = threading.Event()
        saving = threading.Thread(target=save, args=(cluster, name, is_killed), daemon=True)
        saving.start()
        wait_for(lambda: any((data_folder / name).glob("snapshot-*.tmp")))
        cluster.kill(first)
        is_killed.set()
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
