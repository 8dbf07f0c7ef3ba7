"""The events of a session, as a watcher that comes again asks for them."""

from services.gateway.events import EventKind, SessionEvents


def test_a_watcher_gets_what_came_after_the_last_that_it_heard():
    events = SessionEvents()
    events.add(EventKind.SAVED, revision=1)
    events.add(EventKind.SAVED, revision=2)
    first, second = events.after(0)

    assert events.after(first.number) == [second]


def test_a_watcher_of_an_earlier_life_of_the_gateway_gets_everything():
    before = SessionEvents()
    before.add(EventKind.SAVED, revision=1)
    after = SessionEvents()
    after.add(EventKind.SAVED, revision=2)

    assert len(after.after(before.after(0)[-1].number)) == 1


def test_a_number_that_was_never_sent_hides_nothing():
    events = SessionEvents()
    events.add(EventKind.SAVED, revision=1)

    assert len(events.after(1 << 60)) == 1
