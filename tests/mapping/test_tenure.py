"""A process and the sessions that it owns."""

from __future__ import annotations

import queue
import subprocess
import time
from collections.abc import Callable, Iterator

import pytest

from benchmarks.cluster import wait_for
from services.mapping.storage.leases import open_lease_store
from services.mapping.storage.tenure import Tenure, is_departed, process_identity
from shared.errors import ConflictError, GoneError


@pytest.fixture
def tenure(tmp_path) -> Iterator[Callable[..., Tenure]]:
    """Makes a process's tenure over one shared table; `lost` receives what it loses."""
    made = []

    def make(name: str, ttl_s: float = 600.0, lost=lambda session, epoch: None) -> Tenure:
        made.append(Tenure(open_lease_store("", tmp_path), name, ttl_s, lost))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_claimed_session_is_held(tenure):
    lease = tenure("a").claim("room", above=6)

    lease.check()
    assert lease.epoch == 7


def test_a_lease_is_held_for_longer_than_its_time_by_renewals(tenure):
    lease = tenure("a", ttl_s=0.5).claim("room", above=0)

    time.sleep(0.5)

    wait_for(lease.is_valid)  # without a renewal it would be over for ever


def test_a_namesake_in_another_process_is_somebody_else(tenure):
    tenure("a").claim("room", above=0)
    other = tenure("a")
    other._owner = "a@elsewhere:1"

    with pytest.raises(ConflictError):
        other.claim("room", above=0)


def test_an_owner_that_cannot_renew_acts_no_longer(tenure, tmp_path):
    a = tenure("a", ttl_s=0.5)
    lease = a.claim("room", above=0)
    a._is_closed.set()  # its thread is starved, as in a frozen process

    time.sleep(0.5)

    with pytest.raises(GoneError, match="epoch 1 is over"):
        lease.check()


def test_the_loss_of_a_session_is_told(tenure, tmp_path):
    lost: queue.Queue[tuple[str, int]] = queue.Queue()
    a = tenure("a", 0.5, lambda session, epoch: lost.put((session, epoch)))
    lease = a.claim("room", above=0)
    open_lease_store("", tmp_path).claim("room", "b", 0, 600.0, departed=a._owner)

    assert lost.get(timeout=60.0) == ("room", 1)
    with pytest.raises(GoneError):
        lease.check()


def test_a_released_session_is_free_to_others(tenure, tmp_path):
    a = tenure("a")
    a.claim("room", above=0)

    a.release("room")

    assert open_lease_store("", tmp_path).claim("room", "b", 0, 600.0) == 2


def test_a_dead_process_of_this_machine_has_departed():
    process = subprocess.Popen(["true"])
    process.wait()
    place = process_identity("a").rpartition(":")[0]

    assert is_departed(f"{place}:{process.pid}")
    assert not is_departed(process_identity("a"))
    assert not is_departed(f"a@another-machine/pid:[1]:{process.pid}")
