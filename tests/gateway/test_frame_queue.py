"""Frames of one session: in order, one in flight."""

import asyncio

import pytest

from services.gateway.errors import OrderError
from services.gateway.frame_queue import FrameQueue
from shared.errors import InputError, PointSlamError, UnavailableError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, TrackingStatus
from shared.stream import DepthMessage, FrameMessage, FrameReply


def message(seq):
    rgb = ColourImage(ColourEncoding.JPEG, b"")
    return FrameMessage(seq, 10 * seq, rgb, DepthMessage(DepthEncoding.RAW16, b""))


class Answers:
    """Answers each frame after a turn of the loop; refuses those in `bad`."""

    def __init__(self, *bad):
        self.bad = bad
        self.order = []
        self.in_flight = 0

    async def __call__(self, frame, _):
        self.in_flight += 1
        assert self.in_flight == 1
        await asyncio.sleep(0)
        self.in_flight -= 1
        if frame.seq in self.bad:
            raise InputError("rgb.bytes", "damaged")
        self.order.append(frame.seq)
        return FrameReply(frame.seq, frame.t_ns, TrackingStatus.TRACKED)


def offline(answers, max_waiting=8):
    return FrameQueue(answers, False, max_waiting, (-1, -1))


def live(answers):
    return FrameQueue(answers, True, 8, (-1, -1))


async def submit_all(queue, *seqs):
    return await asyncio.gather(*[queue.submit(message(seq)) for seq in seqs])


def test_offline_frames_are_answered_one_at_a_time_in_order():
    answers = Answers()

    async def run():
        await submit_all(offline(answers), 0, 1, 2, 5)

    asyncio.run(run())

    assert answers.order == [0, 1, 2, 5]


def test_live_frames_that_wait_give_way_to_the_newest():
    async def run():
        queue = live(Answers())
        first = queue.submit(message(0))
        await asyncio.sleep(0)
        rest = await submit_all(queue, 1, 2, 3)
        return [await first, *rest]

    statuses = [reply.status for reply in asyncio.run(run())]

    assert statuses == [
        TrackingStatus.TRACKED,
        TrackingStatus.SUPERSEDED,
        TrackingStatus.SUPERSEDED,
        TrackingStatus.TRACKED,
    ]


@pytest.mark.parametrize("seq", [0, 3])
def test_a_number_that_does_not_grow_is_refused_at_once(seq):
    async def run():
        queue = offline(Answers())
        await submit_all(queue, 3)
        queue.submit(message(seq))

    with pytest.raises(OrderError, match="seq: must be more than 3"):
        asyncio.run(run())


def test_a_frame_must_also_come_after_those_that_wait():
    async def run():
        queue = offline(Answers())
        queue.submit(message(5))
        queue.submit(message(6))
        queue.submit(message(6))

    with pytest.raises(OrderError):
        asyncio.run(run())


def test_the_number_of_a_refused_frame_may_come_again():
    answers = Answers(1)

    async def run():
        queue = offline(answers)
        _, refused = await submit_all(queue, 0, 1)
        answers.bad = ()
        again = await queue.submit(message(1))
        return refused, again

    refused, again = asyncio.run(run())

    assert isinstance(refused, InputError)
    assert isinstance(again, FrameReply)
    assert again.status is TrackingStatus.TRACKED


def test_a_fault_of_ours_is_told_and_the_next_frame_is_answered():
    async def answer(frame, _):
        if frame.seq == 0:
            raise ZeroDivisionError
        return FrameReply(frame.seq, frame.t_ns, TrackingStatus.TRACKED)

    async def run():
        return await submit_all(offline(answer), 0, 1)

    fault, good = asyncio.run(run())

    assert type(fault) is PointSlamError
    assert isinstance(good, FrameReply)


def test_too_many_waiting_frames_are_refused():
    async def run():
        await submit_all(offline(Answers(), max_waiting=2), 0, 1, 2, 3)

    with pytest.raises(UnavailableError, match="wait already"):
        asyncio.run(run())


def test_a_closed_queue_refuses_what_waits():
    async def run():
        queue = offline(Answers())
        future = queue.submit(message(0))
        queue.refuse(UnavailableError("the session was closed"))
        return await future

    assert isinstance(asyncio.run(run()), UnavailableError)
