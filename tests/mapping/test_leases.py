"""Leases: one owner at a time, epochs that only grow, on both databases."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.mapping.storage.leases import LeaseStore, open_lease_store
from shared.errors import ConfigError, ConflictError, StorageError


def _postgres_programs() -> Path:
    found = shutil.which("initdb")
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if found is None and not installed:
        pytest.skip("PostgreSQL is not installed (apt-get install postgresql)")
    return Path(found or installed[-1]).parent


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """A server of this test's own on loopback; its URL."""
    pytest.importorskip("psycopg", reason="psycopg is not installed")
    programs = _postgres_programs()
    folder = Path(tempfile.mkdtemp(prefix="pointslam-pg-"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    as_user = []
    if os.geteuid() == 0:  # PostgreSQL refuses to run as root
        shutil.chown(folder, "postgres")
        as_user = ["runuser", "-u", "postgres", "--"]

    def run(program: str, *arguments: str) -> None:
        command = [*as_user, str(programs / program), "-D", str(folder / "db"), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=folder)

    run("initdb", "-A", "trust", "-U", "tester", "--no-sync")
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1"
    run("pg_ctl", "start", "-w", "-o", options, "-l", str(folder / "log"))
    yield f"postgresql://tester@127.0.0.1:{port}/postgres"
    run("pg_ctl", "stop", "-m", "immediate")
    shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "postgres"])
def url(request, tmp_path) -> str:
    return "" if request.param == "sqlite" else request.getfixturevalue("postgres")


@pytest.fixture
def store(url, tmp_path) -> Iterator[LeaseStore]:
    store = open_lease_store(url, tmp_path)
    store.forget("room")
    yield store
    store.close()


def test_a_free_session_is_claimed_above_the_epoch_that_its_folder_knows(store):
    assert store.claim("room", "a", above=4, ttl_s=600.0) == 5


def test_a_running_lease_keeps_others_out(store):
    store.claim("room", "a", above=0, ttl_s=600.0)

    with pytest.raises(ConflictError, match=r"owned by a for \d"):
        store.claim("room", "b", above=0, ttl_s=600.0)


def test_an_owner_may_claim_again_in_a_new_epoch(store):
    first = store.claim("room", "a", above=0, ttl_s=600.0)

    assert store.claim("room", "a", above=0, ttl_s=600.0) == first + 1


def test_a_dead_owner_is_succeeded_at_once(store):
    store.claim("room", "a", above=0, ttl_s=600.0)

    assert store.claim("room", "b", above=0, ttl_s=600.0, departed="a") == 2


def test_a_lease_that_ended_is_taken_and_cannot_be_renewed(store):
    store.claim("room", "a", above=0, ttl_s=0.05)
    time.sleep(0.1)

    epoch = store.claim("room", "b", above=0, ttl_s=600.0)

    assert epoch == 2
    assert not store.renew("room", "a", 1, 600.0)
    assert store.renew("room", "b", epoch, 600.0)


def test_a_lease_that_ended_and_that_nobody_took_is_renewed(store):
    epoch = store.claim("room", "a", above=0, ttl_s=0.05)
    time.sleep(0.1)

    assert store.renew("room", "a", epoch, 600.0)


def test_a_released_session_is_free_at_once(store):
    store.release("room", "a", store.claim("room", "a", above=0, ttl_s=600.0))

    assert store.claim("room", "b", above=0, ttl_s=600.0) == 2


def test_a_former_owner_cannot_release_the_next_ones_lease(store):
    old = store.claim("room", "a", above=0, ttl_s=600.0)
    store.claim("room", "b", above=0, ttl_s=600.0, departed="a")

    store.release("room", "a", old)

    with pytest.raises(ConflictError):
        store.claim("room", "c", above=0, ttl_s=600.0)


def test_two_stores_see_one_table(store, url, tmp_path):
    other = open_lease_store(url, tmp_path)
    store.claim("room", "a", above=0, ttl_s=600.0)

    with pytest.raises(ConflictError):
        other.claim("room", "b", above=0, ttl_s=600.0)
    other.close()


def test_a_store_out_of_reach_is_a_storage_error():
    store = open_lease_store("postgresql://nobody@127.0.0.1:1/none", Path())

    with pytest.raises(StorageError, match="lease store"):
        store.claim("room", "a", above=0, ttl_s=1.0)


def test_an_unknown_store_is_refused_without_its_password():
    with pytest.raises(ConfigError, match="mysql:") as refused:
        open_lease_store("mysql://me:secret@host/db", Path())

    assert "secret" not in str(refused.value)
