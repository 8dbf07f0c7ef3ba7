"""The pool of threads: every piece of work is done once, and callers do not wait for each other."""

import threading

import pytest

from services.mapping.rasterizer.threads import Workers


def test_every_thread_runs_the_kernel_with_the_same_counter():
    calls, meeting = [], threading.Barrier(3)

    def kernel(name, counter):
        calls.append((name, id(counter)))
        meeting.wait(timeout=60)

    Workers(3).run(kernel, "piece")

    assert len(calls) == 3
    assert len(set(calls)) == 1


def test_a_caller_works_alone_while_the_helpers_are_busy():
    pool, started, release = Workers(2), threading.Event(), threading.Event()

    def endless(counter):
        started.set()
        release.wait(timeout=60)

    busy = threading.Thread(target=pool.run, args=(endless,))
    busy.start()
    started.wait(timeout=60)
    calls = []
    pool.run(lambda counter: calls.append(counter))
    release.set()
    busy.join()

    assert calls


def test_what_a_helper_raises_reaches_the_caller():
    meeting = threading.Barrier(2)

    def kernel(counter):
        meeting.wait(timeout=60)
        if threading.current_thread() is not threading.main_thread():
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        Workers(2).run(kernel)
