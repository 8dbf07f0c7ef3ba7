import os
import threading
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
