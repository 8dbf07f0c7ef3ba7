"""Visitors go before the worker's next step."""

from __future__ import annotations

import threading
import time

from services.mapping.turns import Turns


def test_a_visitor_waits_for_one_step_at_most():
    turns, stop, steps = Turns(), threading.Event(), []

    def work() -> None:
        while not stop.is_set():
            with turns.step():
                time.sleep(0.01)
                steps.append(1)

    worker = threading.Thread(target=work)
    worker.start()
    waits = []
    for _ in range(20):
        before = len(steps)
        with turns.visit():
            waits.append(len(steps) - before)
    stop.set()
    worker.join()

    assert max(waits) <= 2  # the step that was running, and one that had just begun


def test_turns_exclude_each_other():
    turns, inside, overlaps = Turns(), [], []

    def visit() -> None:
        for _ in range(50):
            with turns.visit():
                inside.append(1)
                overlaps.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=visit) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert max(overlaps) == 1
