import _thread
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from services.mapping.priority import give_way, others_give_way


def niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


def test_a_thread_gives_way_and_the_others_do_not():
    before = niceness()

    with ThreadPoolExecutor(1, initializer=give_way, initargs=(5,)) as thread:
        lowered = thread.submit(niceness).result()

    assert lowered == min(before + 5, 19)
    assert niceness() == before


def test_threads_started_by_one_that_gives_way_do_so_too():
    def start_another() -> int:
        with ThreadPoolExecutor(1) as inner:
            return inner.submit(niceness).result()

    with ThreadPoolExecutor(1, initializer=give_way, initargs=(5,)) as thread:
        inherited = thread.submit(start_another).result()

    assert inherited == min(niceness() + 5, 19)


def test_the_threads_of_a_pool_give_way_to_the_one_that_asks_them_to():
    with ThreadPoolExecutor(1) as pool:
        before = pool.submit(niceness).result()

        others_give_way(5)

        assert pool.submit(niceness).result() == min(before + 5, 19)
    assert niceness() == before


def test_a_thread_of_a_library_that_has_ended_is_passed_over():
    # Python keeps what it calls a dummy for a thread that it did not start, and does not see it go.
    seen = []
    _thread.start_new_thread(lambda: seen.append(threading.current_thread()), ())
    while not seen or os.path.exists(f"/proc/self/task/{seen[0].native_id}"):
        time.sleep(0.001)

    others_give_way(0)

    assert seen[0] in threading.enumerate()
