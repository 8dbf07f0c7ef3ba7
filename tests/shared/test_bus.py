"""The bus on a real router: replies, errors, silence, pieces, publications, liveliness."""

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from benchmarks.local_gateway import PATIENT_BUS, PATIENT_ROUTER, free_port
from shared import codec
from shared.bus import open_bus, open_router
from shared.errors import (
    ConflictError,
    GoneError,
    InputError,
    NotFoundError,
    PointSlamError,
    StorageError,
    TimedOutError,
    UnavailableError,
)
from shared.maps import DeleteRequest, Empty

KEY = "ps/test/question"


@pytest.fixture(scope="module")
def endpoint():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_router(endpoint, PATIENT_ROUTER)
    yield endpoint
    router.close()


@pytest.fixture
def bus(endpoint):
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus


@pytest.fixture
def other(endpoint):
    with open_bus([endpoint], PATIENT_BUS) as bus:
        yield bus


def serve(bus, other, kind, answer, executor=None):
    """Serve KEY by `other`, and wait until `bus` can reach what it declared."""
    other.serve(KEY, kind, answer, executor)
    other.serve(f"{KEY}/settled", Empty, lambda request: request)
    wait_for(lambda: is_answered(bus, f"{KEY}/settled"))


def is_answered(bus, key):
    try:
        return bus.query(key, Empty(), Empty, 60.0) == Empty()
    except GoneError:
        return False


def wait_for(condition):
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def ask(bus, timeout_s=60.0):
    return bus.query(KEY, DeleteRequest("x"), DeleteRequest, timeout_s)


def test_a_query_is_answered(bus, other):
    serve(bus, other, DeleteRequest, lambda request: DeleteRequest(request.session + "!"))

    assert ask(bus) == DeleteRequest("x!")


def test_an_asynchronous_query_is_answered(bus, other):
    serve(bus, other, DeleteRequest, lambda request: request)

    async def run():
        return await asyncio.gather(
            *[bus.ask(KEY, DeleteRequest(str(i)), DeleteRequest, 60.0) for i in range(20)]
        )

    assert [reply.session for reply in asyncio.run(run())] == [str(i) for i in range(20)]


@pytest.mark.parametrize(
    "error",
    [
        InputError("frame.seq", "must grow"),
        NotFoundError("no such thing"),
        ConflictError("there already"),
        UnavailableError("later"),
        StorageError("disk full"),
    ],
    ids=lambda error: error.code,
)
def test_an_error_arrives_as_its_own_class_with_its_text(bus, other, error):
    def answer(_):
        raise error

    serve(bus, other, DeleteRequest, answer)

    with pytest.raises(type(error)) as caught:
        ask(bus)
    assert str(caught.value) == str(error)


def test_a_fault_of_the_other_side_tells_nothing_of_its_inside(bus, other):
    serve(bus, other, DeleteRequest, lambda _: 1 / 0)

    with pytest.raises(PointSlamError, match="internal error") as caught:
        ask(bus)
    assert "division" not in str(caught.value)


def test_a_message_of_the_wrong_kind_is_refused_by_field(bus, other):
    serve(bus, other, Empty, lambda request: request)

    with pytest.raises(InputError, match="unknown field") as caught:
        ask(bus)
    assert caught.value.field == "Empty.session"


def test_nobody_there_is_gone_at_once(bus):
    with pytest.raises(GoneError):  # after its time it would have timed out
        ask(bus, timeout_s=600.0)


def test_one_that_leaves_in_the_middle_is_gone(bus, endpoint):
    other = open_bus([endpoint], PATIENT_BUS)
    asked, finish = threading.Event(), threading.Event()

    def answer(request):
        asked.set()
        finish.wait(60.0)
        return request

    with ThreadPoolExecutor(2) as pool:
        serve(bus, other, DeleteRequest, answer, pool)
        question = pool.submit(ask, bus, 60.0)
        asked.wait(60.0)
        other.close()

        with pytest.raises(GoneError):
            question.result()
        finish.set()


def test_what_is_under_way_is_answered_by_one_that_has_withdrawn(bus, other):
    asked, finish = threading.Event(), threading.Event()

    def answer(request):
        asked.set()
        finish.wait(60.0)
        return request

    with ThreadPoolExecutor(2) as pool:
        serve(bus, other, DeleteRequest, answer, pool)
        question = pool.submit(ask, bus, 60.0)
        asked.wait(60.0)
        other.withdraw()
        is_gone = not is_answered(bus, f"{KEY}/settled")
        finish.set()

        assert question.result() == DeleteRequest("x")
        assert is_gone


def test_one_that_is_too_slow_times_out(bus, other):
    late = threading.Event()

    with ThreadPoolExecutor(1) as pool:
        serve(bus, other, DeleteRequest, lambda request: late.wait(60.0) and request, pool)

        with pytest.raises(TimedOutError):
            ask(bus, timeout_s=0.2)
        late.set()


def test_an_executor_answers_several_at_a_time(bus, other):
    barrier = threading.Barrier(2, timeout=60.0)

    def answer(request):
        barrier.wait()
        return request

    with ThreadPoolExecutor(2) as pool:
        serve(bus, other, DeleteRequest, answer, pool)

        async def run():
            question = bus.ask(KEY, DeleteRequest("x"), DeleteRequest, 60.0)
            return await asyncio.gather(
                question, bus.ask(KEY, DeleteRequest("y"), DeleteRequest, 60.0)
            )

        replies = asyncio.run(run())

    assert {reply.session for reply in replies} == {"x", "y"}


def test_publications_reach_who_listens(bus, other):
    heard = []
    other.subscribe("ps/test/news", DeleteRequest, heard.append)

    def publish():
        bus.publish("ps/test/news", DeleteRequest("now"))
        return heard

    wait_for(publish)
    assert heard[0] == DeleteRequest("now")


def test_publications_that_are_no_news_are_not_read(bus, other):
    heard, old = [], codec.pack(DeleteRequest("old"))
    other.subscribe("ps/test/news", DeleteRequest, heard.append, lambda data: data != old)

    def publish():
        bus.publish("ps/test/news", DeleteRequest("old"))
        bus.publish("ps/test/news", DeleteRequest("new"))
        return heard

    wait_for(publish)
    assert set(heard) == {DeleteRequest("new")}


def test_neither_a_subscriber_nor_one_who_answers_on_an_executor_takes_a_thread(bus):
    before = threading.active_count()

    with ThreadPoolExecutor() as executor:
        for number in range(10):
            bus.subscribe(f"ps/test/news/{number}", Empty, lambda _: None)
            bus.serve(f"ps/test/questions/{number}", Empty, lambda request: request, executor)

        assert threading.active_count() <= before  # one of another test may end


def test_a_publication_of_the_wrong_kind_is_dropped(bus, other):
    heard = []
    other.subscribe("ps/test/news", Empty, heard.append)

    def publish():
        bus.publish("ps/test/news", DeleteRequest("now"))
        bus.publish("ps/test/news", Empty())
        return heard

    wait_for(publish)
    assert set(map(type, heard)) == {Empty}


def test_a_process_is_alive_until_it_leaves(bus, endpoint):
    alive = set()
    bus.watch_alive(
        "testing", lambda name, is_alive: (alive.add if is_alive else alive.discard)(name)
    )

    with open_bus([endpoint], PATIENT_BUS) as other:
        other.declare_alive("testing", "one")
        wait_for(lambda: alive == {"one"})

    wait_for(lambda: alive == set())


def test_one_who_comes_late_hears_of_those_alive(bus, other):
    other.declare_alive("testing", "one")
    alive = set()

    bus.watch_alive("testing", lambda name, is_alive: alive.add(name))

    wait_for(lambda: alive == {"one"})


def test_a_router_that_is_not_there_is_unavailable():
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    with pytest.raises(UnavailableError, match=endpoint):
        open_bus([endpoint], wait_s=0.1)


def test_a_taken_endpoint_is_unavailable(endpoint):
    with pytest.raises(UnavailableError, match="cannot listen"):
        open_router(endpoint)
