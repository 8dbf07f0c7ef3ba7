"""Who owns which session's map: leases with a fencing epoch, in a transactional store.

One row a session: its owner, an epoch that grows with every change of owner, and when the lease
ends by the store's own clock. A change is one compare-and-swap statement, so two mappers that
want the same session cannot both get it. SQLite serves the mappers of one machine, PostgreSQL
those of several; the statements are the same.
"""

from __future__ import annotations

import re
import sqlite3
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.errors import ConfigError, ConflictError, StorageError

_NAMED = re.compile(r":(\w+)")

_CREATE = """
CREATE TABLE IF NOT EXISTS leases (
    session TEXT PRIMARY KEY, owner TEXT NOT NULL, epoch BIGINT NOT NULL,
    expires_s DOUBLE PRECISION NOT NULL)
"""
_CLAIM = """
INSERT INTO leases (session, owner, epoch, expires_s)
VALUES (:session, :owner, :above + 1, {now_s} + :ttl_s)
ON CONFLICT (session) DO UPDATE SET
    owner = excluded.owner,
    epoch = CASE WHEN leases.epoch < excluded.epoch THEN excluded.epoch ELSE leases.epoch + 1 END,
    expires_s = excluded.expires_s
WHERE leases.owner IN (:owner, :departed) OR leases.expires_s <= {now_s}
RETURNING epoch
"""
_RENEW = """
UPDATE leases SET expires_s = {now_s} + :ttl_s
WHERE session = :session AND owner = :owner AND epoch = :epoch RETURNING epoch
"""
_RELEASE = """
UPDATE leases SET expires_s = 0 WHERE session = :session AND owner = :owner AND epoch = :epoch
"""
_HOLDER = "SELECT owner, expires_s - {now_s} FROM leases WHERE session = :session"
_FORGET = "DELETE FROM leases WHERE session = :session"


@dataclass(frozen=True)
class Database:
    """What differs between the databases that can hold the leases."""

    name: str
    connect: Callable[[], Any]  # a DB-API connection in autocommit
    error: type[Exception]
    now_s: str  # SQL: seconds since 1970 by the database's clock
    names_parameters: Callable[[str], str]  # from ":name" to the driver's way


@dataclass(frozen=True)
class Holder:
    """Who holds a lease, and for how much longer without renewal (negative: it has ended)."""

    owner: str
    left_s: float


class LeaseStore:
    """The table of leases; safe from any thread, reconnects after an error.

    Every method raises StorageError where the database refuses or cannot be reached.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._connection: Any = None

    def claim(self, session: str, owner: str, above: int, ttl_s: float, departed: str = "") -> int:
        """Take a session that is free, our own, or held by `departed`; returns the new epoch.

        Args:
            session: its name.
            owner: who claims it.
            above: the epoch that the session's folder knows; the new one is larger.
            ttl_s: the lease ends so long after the last renewal.
            departed: an owner that is known to be dead.

        Raises:
            ConflictError: another owner's lease is running; says whose and for how long.
        """
        values = {"session": session, "owner": owner, "above": above, "ttl_s": ttl_s}
        rows = self._run(_CLAIM, values | {"departed": departed})
        if rows:
            return int(rows[0][0])
        holder = self.holder(session)
        by = f"{holder.owner} for {max(holder.left_s, 0.0):.1f} s" if holder else "another mapper"
        raise ConflictError(f"session {session} is owned by {by}")

    def renew(self, session: str, owner: str, epoch: int, ttl_s: float) -> bool:
        """Hold a session for longer; false when another owner has taken it."""
        values = {"session": session, "owner": owner, "epoch": epoch, "ttl_s": ttl_s}
        return bool(self._run(_RENEW, values))

    def release(self, session: str, owner: str, epoch: int) -> None:
        """Give a session back; nothing if it is not ours any more."""
        self._run(_RELEASE, {"session": session, "owner": owner, "epoch": epoch})

    def holder(self, session: str) -> Holder | None:
        """The last owner of a session; None where there never was one."""
        rows = self._run(_HOLDER, {"session": session})
        return Holder(rows[0][0], float(rows[0][1])) if rows else None

    def forget(self, session: str) -> None:
        """Remove a deleted session's row."""
        self._run(_FORGET, {"session": session})

    def close(self) -> None:
        """Disconnect."""
        with self._lock:
            self._disconnect()

    def _run(self, statement: str, values: Mapping[str, object]) -> list[tuple[Any, ...]]:
        database = self._database
        text = database.names_parameters(statement.format(now_s=database.now_s))
        with self._lock:
            try:
                if self._connection is None:
                    self._connection = database.connect()
                    self._connection.execute(_CREATE)
                cursor = self._connection.execute(text, values)
                return cursor.fetchall() if cursor.description else []
            except database.error as error:
                self._disconnect()
                raise StorageError(f"lease store ({database.name}): {error}") from error

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def open_lease_store(url: str, data: Path) -> LeaseStore:
    """The store that a setting names: "" is a SQLite file beside the sessions.

    Raises:
        ConfigError: the URL is of no database that we know, or its driver is not installed.
    """
    if not url:
        return LeaseStore(_sqlite(data / "leases.sqlite"))
    if url.startswith(("postgresql://", "postgres://")):
        return LeaseStore(_postgresql(url))
    raise ConfigError(
        f"owner.lease_store must be empty (SQLite beside the sessions) or postgresql://..., "
        f"got {url.partition(':')[0]}:..."
    )


def _sqlite(path: Path) -> Database:
    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(
            path, timeout=2.0, isolation_level=None, check_same_thread=False
        )
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        return connection

    now_s = "((julianday('now') - 2440587.5) * 86400.0)"
    return Database("SQLite", connect, sqlite3.Error, now_s, lambda statement: statement)


def _postgresql(url: str) -> Database:
    try:
        import psycopg
    except ImportError:
        raise ConfigError(
            "owner.lease_store: PostgreSQL needs its driver: pip install 'pointslam[postgres]'"
        ) from None

    def connect() -> psycopg.Connection:
        return psycopg.connect(url, autocommit=True, connect_timeout=2)

    now_s = "CAST(extract(epoch FROM clock_timestamp()) AS double precision)"
    return Database("PostgreSQL", connect, psycopg.Error, now_s, lambda s: _NAMED.sub(r"%(\1)s", s))
