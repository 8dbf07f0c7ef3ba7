"""Inputs that no client should send: values, messages and bytes, near to good ones."""

from __future__ import annotations

import random
from typing import Any

import msgpack

_STRANGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    2**31,
    2**63,
    -(2**63),
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x" * 2000,
    "../../etc/passwd",
    "\u0000\ud7ff",
    b"",
    b"\x00" * 64,
    [],
    [[[[]]]],
    {},
    {"a": {"b": {"c": 1}}},
)
_WORDS = ("nan", "inf", "-1", "0", "1e400", "9" * 30, "", "a" * 300, "%00", "..", "{}", "[1]", "é")


def strange_value(rng: random.Random) -> Any:
    """A value of a kind that a field hardly expects."""
    return rng.choice((*_STRANGE, rng.getrandbits(70), rng.uniform(-1e9, 1e9), rng.randbytes(20)))


def strange_word(rng: random.Random) -> str:
    """A word for a path or a query."""
    return rng.choice((*_WORDS, str(rng.getrandbits(rng.randrange(1, 80))), repr(rng.gauss(0, 10))))


def spoiled(value: Any, rng: random.Random) -> Any:
    """A copy of nested plain values with one of them changed, left out or added."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        change = rng.random()
        if change < 0.1:
            return {name: below for name, below in value.items() if name != key}
        if change < 0.2:
            return value | {strange_word(rng): strange_value(rng)}
        return value | {key: spoiled(value[key], rng)}
    if isinstance(value, list | tuple) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        return [*value[:at], spoiled(value[at], rng), *value[at + 1 :]]
    if isinstance(value, bytes) and rng.random() < 0.7:
        return spoiled_bytes(value, rng)
    return strange_value(rng)


def spoiled_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes with a few flipped, a part cut, doubled or replaced."""
    low, high = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    kind = rng.randrange(5)
    if kind == 0:
        return data[:low]
    if kind == 1:
        return data[:low] + data[high:]
    if kind == 2:
        return data[:high] + data[low:high][:4096] + data[high:]
    if kind == 3:
        return data[:low] + rng.randbytes(rng.randrange(1, 40)) + data[low:]
    flipped = bytearray(data)
    for _ in range(rng.randrange(1, 9)):
        if flipped:
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def spoiled_message(plain: dict[str, Any], rng: random.Random) -> bytes:
    """A msgpack message with a wrong field, or with wrong bytes."""
    if rng.random() < 0.3:
        return spoiled_bytes(msgpack.packb(plain) or b"", rng)
    try:
        return msgpack.packb(spoiled(plain, rng)) or b""
    except (OverflowError, ValueError):  # too long a number for msgpack itself
        return rng.randbytes(64)
