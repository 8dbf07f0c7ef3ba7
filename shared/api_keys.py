"""API keys: random, told once, kept as hashes in a SQLite file.

A key is `ps_<id>_<secret>`. The id says in lists and logs which key it is; the secret has 256
random bits, so a plain SHA-256 is as good a hash as a slow one.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from urllib.parse import quote

from shared.errors import ConfigError, InputError, NotFoundError, StorageError

PREFIX = "ps_"
DEFAULT_TENANT = "default"
_TENANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
_KEY = re.compile(r"ps_([0-9a-f]{12})_[A-Za-z0-9_-]{43}")
_SCHEMA = """CREATE TABLE IF NOT EXISTS keys (
    id TEXT PRIMARY KEY, digest BLOB NOT NULL, tenant TEXT NOT NULL, scopes TEXT NOT NULL,
    label TEXT NOT NULL, created_s REAL NOT NULL, expires_s REAL, revoked_s REAL)"""
_END_OF_DATES_S = 253_402_300_800.0  # no calendar of Python's goes further
_COLUMNS = "id, tenant, scopes, label, created_s, expires_s, revoked_s"


class Scope(StrEnum):
    """What a key may do."""

    INGEST = "ingest"  # create sessions and send their frames
    POSE = "pose"  # read poses and trajectories, localize images
    RENDER = "render"  # views of the map, and the map as a file
    ADMIN = "admin"  # refine, save and delete


@dataclass(frozen=True)
class NewKey:
    """What a key shall be; times are seconds since 1970."""

    tenant: str = DEFAULT_TENANT
    scopes: frozenset[Scope] = frozenset(Scope)
    label: str = ""
    expires_s: float | None = None

    def check(self) -> None:
        """Refuse what no key can be with an InputError that names the field."""
        check_tenant(self.tenant)
        if not self.scopes:
            raise InputError("scopes", f"must be some of {', '.join(Scope)}")
        if self.expires_s is not None and not time.time() < self.expires_s < _END_OF_DATES_S:
            raise InputError("expires_s", "must lie in the future, and before the year 10000")


@dataclass(frozen=True)
class KeyRecord:
    """What the store knows of a key; times are seconds since 1970."""

    id: str
    tenant: str
    scopes: frozenset[Scope]
    label: str
    created_s: float
    expires_s: float | None
    revoked_s: float | None

    def refusal(self, now_s: float) -> str | None:
        """Why the key is not accepted; None when it is."""
        if self.revoked_s is not None:
            return "revoked"
        if self.expires_s is not None and now_s >= self.expires_s:
            return "expired"
        return None


def check_tenant(tenant: str) -> None:
    """Refuse what cannot name a tenant with an InputError."""
    if not _TENANT.fullmatch(tenant):
        raise InputError("tenant", "must be 1 to 32 letters, digits, '-' or '_'")


def key_id(text: str) -> str | None:
    """The id in what may be a key; None when it has not the form of one."""
    found = _KEY.fullmatch(text)
    return found[1] if found else None


class KeyStore:
    """Keys in a file. Every look-up reads it: a key is gone the moment that it is revoked."""

    def __init__(self, connection: sqlite3.Connection, file: Path) -> None:
        self._connection = connection
        self._file = file

    @classmethod
    def open(cls, file: Path) -> KeyStore:
        """A store to write; the file is made where there is none, readable by its owner alone.

        Raises:
            StorageError: it cannot be made or is no store.
        """
        with _sqlite_errors(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch(mode=0o600)
            connection = sqlite3.connect(file, isolation_level=None)
            connection.execute(_SCHEMA)
        return cls(connection, file)

    @classmethod
    def open_to_read(cls, file: Path) -> KeyStore:
        """The store of a gateway, which never writes it.

        Raises:
            ConfigError: there is none; says how one is made.
        """
        if not file.is_file():
            raise ConfigError(
                f"no keys at {file}; make the first with: pointslam keys create --store {file}"
            )
        with _sqlite_errors(file):
            connection = sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)
            connection.execute(f"SELECT {_COLUMNS} FROM keys LIMIT 1")
        return cls(connection, file)

    def create(self, new: NewKey) -> str:
        """Make a key; returns its text, which is kept nowhere.

        Raises:
            InputError: a field cannot be used.
        """
        new.check()
        id = secrets.token_hex(6)
        text = f"{PREFIX}{id}_{secrets.token_urlsafe(32)}"
        scopes = " ".join(sorted(new.scopes))
        values = (id, _digest(text), new.tenant, scopes, new.label, time.time(), new.expires_s)
        with _sqlite_errors(self._file):
            self._connection.execute("INSERT INTO keys VALUES (?, ?, ?, ?, ?, ?, ?, NULL)", values)
        return text

    def records(self) -> list[KeyRecord]:
        """All keys, oldest first."""
        with _sqlite_errors(self._file):
            rows = self._connection.execute(f"SELECT {_COLUMNS} FROM keys ORDER BY created_s")
            return [_record(row) for row in rows]

    def revoke(self, id: str) -> None:
        """End a key now.

        Raises:
            NotFoundError: there is none of that id.
        """
        change = "UPDATE keys SET revoked_s = coalesce(revoked_s, ?) WHERE id = ?"
        with _sqlite_errors(self._file):
            if self._connection.execute(change, (time.time(), id)).rowcount == 0:
                raise NotFoundError(f"no key {id} in {self._file}")

    def record(self, id: str) -> KeyRecord | None:
        """What is known of the key of an id."""
        with _sqlite_errors(self._file):
            query = f"SELECT {_COLUMNS} FROM keys WHERE id = ?"
            row = self._connection.execute(query, (id,)).fetchone()
        return _record(row) if row else None

    def find(self, text: str) -> KeyRecord | None:
        """The key of this text, be it valid or not; None when it is no key of ours.

        The time that it takes does not tell how much of the text was right.
        """
        id = key_id(text)
        if id is None:
            return None
        with _sqlite_errors(self._file):
            row = self._connection.execute("SELECT digest FROM keys WHERE id = ?", (id,)).fetchone()
        if not hmac.compare_digest(_digest(text), row[0] if row else bytes(32)):
            return None
        return self.record(id)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def _record(row: tuple) -> KeyRecord:
    id, tenant, scopes, label, created_s, expires_s, revoked_s = row
    known = frozenset(Scope(scope) for scope in scopes.split())
    return KeyRecord(id, tenant, known, label, created_s, expires_s, revoked_s)


@contextmanager
def _sqlite_errors(file: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        raise StorageError(f"{file}: {error}") from None
