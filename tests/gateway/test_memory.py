"""What a gateway holds when its clients are gone: nothing of them."""

import asyncio
import gc
import time
import weakref

import pytest

from pointslam.client.messages import frame_message
from services.gateway.access.caller import CALLER, Caller
from services.gateway.app import open_sessions
from services.gateway.config import GatewayConfig
from services.gateway.create_request import CreateRequest
from services.gateway.frame_stream import FrameStream, SessionFrames
from shared.bus import open_bus

WAVES, CLIENTS = 2, 20
PATIENCE_S = 60.0


class VanishedError(Exception):
    """The client is gone."""


@pytest.fixture
def bus(gateway):
    with open_bus([gateway.router]) as bus:
        yield bus


async def send_and_vanish(session, messages, fabric):
    """Send frames and be gone, whatever is answered."""

    async def read(frames):
        for message in messages:
            await frames.put(lambda message=message: message, lambda: (-1, -1))
        raise VanishedError

    async def send(_):
        raise VanishedError

    with pytest.raises(VanishedError):
        await FrameStream(SessionFrames(session), fabric, send).run(read)


async def wave(sessions, calibration, messages):
    """Sessions whose clients vanish and that are deleted then: weak references to them."""
    opened = [await sessions.create(CreateRequest(calibration)) for _ in range(CLIENTS)]
    fabric = sessions.fabric
    await asyncio.gather(*[send_and_vanish(session, messages, fabric) for session in opened])
    for session in opened:
        await sessions.delete(session.name)
    return [weakref.ref(part) for session in opened for part in (session, session.owner)]


async def alive_after_waves(bus, calibration, messages):
    """How many of the sessions, and of their maps' owners, are left when all have had time."""
    CALLER.set(Caller("test"))
    sessions = open_sessions(bus, GatewayConfig())
    while not sessions.is_ready():
        await asyncio.sleep(0.01)
    left = [each for _ in range(WAVES) for each in await wave(sessions, calibration, messages)]
    deadline = time.monotonic() + PATIENCE_S
    while (alive := count_alive(left)) and time.monotonic() < deadline:
        await asyncio.sleep(0.05)
    return alive


def count_alive(references):
    gc.collect()
    return sum(reference() is not None for reference in references)


def test_sessions_of_clients_that_vanished_are_not_kept_alive(bus, calibration, rgb, depth):
    # A subscriber that stayed declared would hold its session: it calls its methods.
    messages = [frame_message(seq, seq, rgb, depth) for seq in range(2)]

    alive = asyncio.run(alive_after_waves(bus, calibration, messages))

    assert alive == 0


async def alive_after_a_race(bus, calibration):
    """What is left of sessions that one gateway deletes while it takes them up again."""
    CALLER.set(Caller("test"))
    makers, takers = (open_sessions(bus, GatewayConfig()) for _ in range(2))
    while not (makers.is_ready() and takers.is_ready()):
        await asyncio.sleep(0.01)
    left = []
    for _ in range(CLIENTS):
        name = (await makers.create(CreateRequest(calibration))).name
        taking = asyncio.create_task(takers.get(name))
        await asyncio.sleep(0)  # it has begun
        await takers.delete(name)
        left.append(weakref.ref(await taking))
        del taking
    deadline = time.monotonic() + PATIENCE_S
    while (alive := count_alive(left)) and time.monotonic() < deadline:
        await asyncio.sleep(0.05)
    return alive


def test_a_session_that_is_deleted_while_it_is_opened_is_not_kept_alive(bus, calibration):
    assert asyncio.run(alive_after_a_race(bus, calibration)) == 0
