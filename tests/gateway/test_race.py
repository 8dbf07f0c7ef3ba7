"""One question asked of several workers."""

import asyncio
from collections.abc import Coroutine
from typing import Any

from services.gateway.race import Race


async def answer(event: asyncio.Event, value: str) -> str:
    await event.wait()
    return value


def asked(question: Coroutine[Any, Any, str]) -> asyncio.Future[str]:
    return asyncio.ensure_future(question)


def test_the_first_to_answer_ends_it_and_the_silent_one_is_named():
    async def run():
        race, never, now = Race[str](), asyncio.Event(), asyncio.Event()
        race.enter("silent", asked(answer(never, "a")))
        assert await race.ended(0.01) == []
        race.enter("quick", asked(answer(now, "b")))
        now.set()
        ((worker, task),) = await race.ended(60.0)
        silent = race.silent(0.0)
        race.close()
        return worker, task.result(), silent

    assert asyncio.run(run()) == ("quick", "b", ["silent"])


def test_a_worker_that_failed_is_under_way_no_more():
    async def fail() -> str:
        raise ValueError("broken")

    async def run():
        race = Race[str]()
        race.enter("broken", asked(fail()))
        ((worker, task),) = await race.ended(60.0)
        return worker, str(task.exception()), race.workers

    assert asyncio.run(run()) == ("broken", "broken", set())


def test_who_is_not_waited_for_is_cancelled():
    async def run():
        race, question = Race[str](), asyncio.Future[str]()
        race.enter("silent", question)
        await race.ended(0.01)
        race.close()
        return question.cancelled()

    assert asyncio.run(run())
