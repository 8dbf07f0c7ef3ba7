"""Work beside a frame: whichever thread does it, it is done once, and its result is there."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.tracking.executors import NoHelper, Once, taken_over


def test_what_a_busy_thread_has_not_begun_is_done_here():
    may_end = threading.Event()
    with ThreadPoolExecutor(1) as helper:
        helper.submit(may_end.wait)
        future = helper.submit(threading.get_ident)

        doer = taken_over(future, threading.get_ident)

        may_end.set()
    assert doer == threading.get_ident()


def test_what_a_thread_has_begun_is_waited_for():
    has_begun, may_end = threading.Event(), threading.Event()

    def work() -> int:
        has_begun.set()
        may_end.wait()
        return threading.get_ident()

    with ThreadPoolExecutor(1) as helper:
        future = helper.submit(work)
        has_begun.wait()
        may_end.set()

        doer = taken_over(future, threading.get_ident)

    assert doer != threading.get_ident()


def test_an_error_of_the_thread_comes_here():
    future = NoHelper().submit(int, "no number")

    with pytest.raises(ValueError, match="no number"):
        taken_over(future, lambda: 0)


def test_work_that_two_threads_ask_for_is_done_by_the_first():
    has_begun, may_end = threading.Event(), threading.Event()

    def work() -> int:
        has_begun.set()
        may_end.wait()
        return threading.get_ident()

    once = Once(work)
    with ThreadPoolExecutor(1) as helper:
        theirs = helper.submit(once.result)
        has_begun.wait()
        may_end.set()

        mine = once.result()

    assert mine == theirs.result() != threading.get_ident()


def test_an_error_of_shared_work_comes_to_everyone_who_asks():
    once = Once(lambda: int("no number"))

    for _ in range(2):
        with pytest.raises(ValueError, match="no number"):
            once.result()
