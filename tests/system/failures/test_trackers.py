"""Tracking workers that die or freeze."""

import time

import pytest

pytestmark = pytest.mark.system


def test_a_killed_tracker_costs_no_frame_and_no_accuracy(cluster, streaming, moment_s):
    with streaming():
        time.sleep(moment_s)
        cluster.kill("tracker-0")  # each of the two serves at least one of three sessions
        cluster.start("tracker-0")


def test_a_frozen_tracker_costs_no_frame_and_may_wake(cluster, streaming, moment_s):
    with streaming():
        time.sleep(moment_s)
        cluster.freeze("tracker-1")
        time.sleep(3.0)
        cluster.wake("tracker-1")
