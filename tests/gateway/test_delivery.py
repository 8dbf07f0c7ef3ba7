"""Entries on their way to an owner that refuses some of them."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from services.gateway.config import MappingConfig
from services.gateway.delivery import Delivery
from shared.errors import ConflictError, InputError, StorageError, UnavailableError
from shared.frames import TrackingStatus
from shared.tracks import Advance, FrameRecord


def entry(seq):
    T = np.eye(4)
    return Advance(FrameRecord(seq, seq, TrackingStatus.TRACKED, 0, T, T, np.eye(6)))


def to_owner(advance, lost=None, wait_s=60.0):
    owner = SimpleNamespace(session="room", logged_seq=-1, advance=advance)
    owner.lost = lost or asyncio.Event()
    config = MappingConfig(retry_s=0.01, keyframe_wait_s=wait_s, keyframe_max_wait_s=wait_s)
    return Delivery(owner, config)  # pyright: ignore[reportArgumentType]


async def delivered(refusals):
    """Deliver frames 0, 1 and 2 to an owner that raises `refusals[seq]` once each."""
    taken = []

    async def advance(entry):
        if (error := refusals.pop(entry.record.seq, None)) is not None:
            raise error
        taken.append(entry.record.seq)

    delivery = to_owner(advance)
    for seq in range(3):
        await delivery.put(entry(seq))
    assert await delivery.flush(60.0)
    return taken


@pytest.mark.parametrize("error", [InputError("keyframe", "is bad"), ConflictError("too old")])
def test_an_entry_that_is_refused_for_good_does_not_hold_up_the_others(error):
    assert asyncio.run(delivered({1: error})) == [0, 2]


def test_an_entry_that_finds_no_owner_is_sent_again():
    assert asyncio.run(delivered({1: UnavailableError("gone")})) == [0, 1, 2]


def test_a_full_disk_is_told_until_there_is_room_and_nothing_is_lost():
    async def run():
        taken, is_full = [], asyncio.Event()
        is_full.set()

        async def advance(entry):
            if is_full.is_set():
                raise StorageError("no space left")
            taken.append(entry.record.seq)

        delivery = to_owner(advance)
        await delivery.put(entry(0))
        await delivery.settle()
        problem = delivery.problem
        is_full.clear()
        await delivery.flush(60.0)
        return str(problem), delivery.problem, taken

    assert asyncio.run(run()) == ("no space left", None, [0])


def test_nobody_waits_for_an_owner_that_is_lost():
    async def run():
        lost, never = asyncio.Event(), asyncio.Event()

        async def advance(entry):
            lost.set()
            await never.wait()

        delivery = to_owner(advance, lost)
        await delivery.put(entry(0))
        await asyncio.wait_for(delivery.settle(), 60.0)
        problem = delivery.problem
        delivery.give_up()
        return str(problem)

    assert "no owner" in asyncio.run(run())


def test_an_owner_that_keeps_silent_holds_no_pose_up_and_gets_its_entry_later():
    async def run():
        taken, wakes = [], asyncio.Event()

        async def advance(entry):
            await wakes.wait()
            taken.append(entry.record.seq)

        delivery = to_owner(advance, wait_s=0.01)
        await delivery.put(entry(0))
        await asyncio.wait_for(delivery.settle(), 60.0)
        before = list(taken)
        wakes.set()
        await delivery.flush(60.0)
        return before, taken

    assert asyncio.run(run()) == ([], [0])
