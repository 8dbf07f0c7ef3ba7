"""API keys of a gateway: `pointslam keys create | list | revoke`, or `python -m pointslam.keys`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from shared.api_keys import DEFAULT_TENANT, KeyRecord, KeyStore, NewKey, Scope
from shared.errors import InputError, PointSlamError

_DAY_S = 86400.0


def add_key_commands(parser: argparse.ArgumentParser) -> None:
    """The commands; each leaves a function from its arguments to its text in `keys_command`."""
    commands = parser.add_subparsers(required=True, metavar="create|list|revoke")
    create = commands.add_parser("create", help="a new key, told this once")
    create.add_argument("--tenant", default=DEFAULT_TENANT, help="whose sessions it sees")
    create.add_argument("--scopes", default=",".join(Scope), help="of ingest,pose,render,admin")
    create.add_argument("--days", type=float, metavar="N", help="its life; without end by default")
    create.add_argument("--label", default="", help="what it is for")
    create.set_defaults(keys_command=_create)
    show = commands.add_parser("list", help="all keys, without their secrets")
    show.set_defaults(keys_command=_list)
    revoke = commands.add_parser("revoke", help="end a key now")
    revoke.add_argument("id", metavar="ID", help="as `list` shows it")
    revoke.set_defaults(keys_command=_revoke)
    for command in (create, show, revoke):
        command.add_argument("--store", type=Path, required=True, metavar="FILE")


def _create(arguments: argparse.Namespace) -> str:
    expires_s = None if arguments.days is None else time.time() + arguments.days * _DAY_S
    scopes = frozenset(_scope(word) for word in arguments.scopes.split(",") if word)
    new = NewKey(arguments.tenant, scopes, arguments.label, expires_s)
    new.check()
    return KeyStore.open(arguments.store).create(new)


def _scope(word: str) -> Scope:
    if word not in list(Scope):
        raise InputError("scopes", f"must be some of {', '.join(Scope)}, got {word!r}")
    return Scope(word)


def _list(arguments: argparse.Namespace) -> str:
    records = KeyStore.open_to_read(arguments.store).records()
    head = ("ID", "TENANT", "SCOPES", "CREATED", "EXPIRES", "STATE", "LABEL")
    rows = [head, *map(_row, records)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
    return "\n".join(lines)


def _row(record: KeyRecord) -> tuple[str, ...]:
    expires = "never" if record.expires_s is None else _date(record.expires_s)
    state = record.refusal(time.time()) or "valid"
    scopes = ",".join(scope for scope in Scope if scope in record.scopes)
    created = _date(record.created_s)
    return (record.id, record.tenant, scopes, created, expires, state, record.label)


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.gmtime(seconds))


def _revoke(arguments: argparse.Namespace) -> str:
    # Read first: a store that is not there is an error here, not a new store.
    KeyStore.open_to_read(arguments.store)
    KeyStore.open(arguments.store).revoke(arguments.id)
    return f"{arguments.id} is revoked"


def main(argv: Sequence[str]) -> int:
    """Run a command; an error of ours is one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="pointslam keys", description=__doc__)
    add_key_commands(parser)
    arguments = parser.parse_args(argv)
    try:
        sys.stdout.write(arguments.keys_command(arguments) + "\n")
    except PointSlamError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
