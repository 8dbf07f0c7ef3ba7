"""Settings: frozen dataclasses nested by step, overridden by a YAML file and by `key=value`."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from shared.errors import ConfigError

C = TypeVar("C")


def override(config: C, changes: Mapping[str, Any], where: str = "") -> C:
    """A copy of `config` with nested changes.

    Raises:
        ConfigError: an unknown key (lists the right ones), a wrong type or a value out of range.
    """
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    hints = typing.get_type_hints(type(config))
    values: dict[str, Any] = {}
    for key, change in changes.items():
        name = f"{where}{key}"
        if key not in hints:
            raise ConfigError(f"unknown setting {name}; known here: {', '.join(hints)}")
        current = getattr(config, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(change, Mapping):
                raise ConfigError(f"{name} is a group of settings, got {change!r}")
            values[key] = override(current, change, f"{name}.")
        else:
            values[key] = _cast(change, current, name)
    return dataclasses.replace(config, **values)


def read_overrides(file: Path | None, assignments: Iterable[str]) -> dict[str, Any]:
    """Changes from a YAML file and from `a.b=value` words, the words last.

    Raises:
        ConfigError: the file is absent or no YAML map, or a word has no `=`.
    """
    changes = _read_yaml(file) if file is not None else {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals:
            raise ConfigError(f"--set takes key=value, got {assignment!r}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        _put(changes, key.strip().split("."), value)
    return changes


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        changes = yaml.safe_load(file.read_text()) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{file}: cannot be read as YAML ({error})") from None
    if not isinstance(changes, dict):
        raise ConfigError(f"{file}: must be a map of settings, got {type(changes).__name__}")
    return changes


def _put(changes: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        below = changes.setdefault(part, {})
        if not isinstance(below, dict):
            raise ConfigError(f"{part} is set both as a value and as a group")
        changes = below
    changes[path[-1]] = value


def _cast(value: Any, current: Any, name: str) -> Any:
    if isinstance(current, bool) or isinstance(value, bool):
        if isinstance(current, bool) and isinstance(value, bool):
            return value
        raise ConfigError(f"{name} must be {type(current).__name__}, got {value!r}")
    if isinstance(current, float) and isinstance(value, int | float | str):
        return _number(float, value, name)
    if isinstance(current, int) and isinstance(value, int | str):
        return _number(int, value, name)
    if isinstance(current, tuple) and isinstance(value, list):
        return tuple(value)
    if current is None or isinstance(value, type(current)):
        return value
    raise ConfigError(f"{name} must be {type(current).__name__}, got {value!r}")


def _number(kind: type, value: Any, name: str) -> Any:
    try:
        number = kind(value)
        if not math.isfinite(number):  # passes every check that asks for too small or too large
            raise ValueError
    except (ValueError, OverflowError):
        raise ConfigError(f"{name} must be {kind.__name__}, got {str(value)[:40]!r}") from None
    return number
