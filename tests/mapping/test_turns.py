"""Visitors go before the worker's next step."""

from __future__ import annotations

import threading

from benchmarks.cluster import wait_for
from services.mapping.turns import Turns


def test_a_visitor_waits_for_the_step_that_is_running_and_no_other():
    turns, is_running, may_end, stop = Turns(), *(threading.Event() for _ in range(3))
    steps = []

    def work() -> None:
        while not stop.is_set():
            with turns.step():
                steps.append(1)
                is_running.set()
                may_end.wait(60.0)

    def visit() -> None:
        with turns.visit():
            seen.append(len(steps))
            stop.set()

    seen: list[int] = []
    worker, visitor = threading.Thread(target=work), threading.Thread(target=visit)
    worker.start()
    is_running.wait(60.0)
    visitor.start()
    wait_for(lambda: turns._visitors == 1)
    may_end.set()
    worker.join()
    visitor.join()

    assert seen == [1]


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
