"""The wire: dataclasses of `shared` to msgpack and back, checked field by field.

One converter serves both forms. In msgpack an array is an extension value (dtype, shape, bytes);
in plain JSON it is nested lists. Nothing is ever unpickled, and what a message may hold is
limited before anything is allocated for it.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from functools import cache, lru_cache, partial
from typing import Any, TypeVar

import msgpack
import numpy as np

from shared.errors import InputError

T = TypeVar("T")

_ARRAY_CODE = 1
_DTYPES = {"<f4", "<f8", "|u1", "<u2", "<i4", "<i8", "|b1"}
_MAX_AXES = 4
_MAX_SMALL = 64  # elements of a list or map of `unpack_fields`
_MAX_ELEMENTS = 1 << 20  # of a list or map; arrays are not limited by this
_PLAIN = {bytes, str, int, float, bool, types.NoneType, np.ndarray}


def pack(message: object) -> bytes:
    """A dataclass as msgpack bytes."""
    return _packb(message)


def unpack(kind: type[T], data: bytes) -> T:
    """Msgpack bytes as a dataclass.

    Raises:
        InputError: the bytes are not msgpack, nest too deep, or a field lacks, is unknown or has
            the wrong type; names the field.
    """
    try:
        plain = msgpack.unpackb(
            data,
            ext_hook=_unpack_array,
            raw=False,
            max_array_len=_MAX_ELEMENTS,
            max_map_len=4096,
        )
    except InputError:
        raise
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        reason = f"not a msgpack message ({type(error).__name__}: {error})"
        raise InputError("message", reason) from None
    return from_plain(kind, plain)


def unpack_fields(data: bytes, names: tuple[str, ...]) -> dict[str, Any]:
    """Some fields of a message that may be damaged elsewhere, as plain values; small ones only.

    What is not asked for is skipped and costs no Python values.
    """
    unpacker = msgpack.Unpacker(
        raw=False, max_array_len=_MAX_SMALL, max_map_len=_MAX_SMALL, ext_hook=_unpack_array
    )
    found: dict[str, Any] = {}
    with suppress(ValueError, TypeError, RecursionError, msgpack.UnpackException):
        unpacker.feed(data)
        for _ in range(unpacker.read_map_header()):
            key = unpacker.unpack()
            if key in names:
                found[key] = unpacker.unpack()
            else:
                unpacker.skip()
    return found


def to_plain(value: Any) -> Any:
    """Dataclasses as dictionaries; arrays stay arrays (see `to_json`)."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if (names := _names(kind)) is not None:
        return {name: to_plain(getattr(value, name)) for name in names}
    if isinstance(value, StrEnum):
        return str(value)
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, np.generic):
        return value.item()
    return value


def to_json(value: Any) -> Any:
    """Like `to_plain`, with arrays as nested lists: what `json.dumps` takes."""
    return _lists(to_plain(value))


def from_plain(kind: type[T], plain: Any, where: str = "") -> T:
    """Build a dataclass from dictionaries.

    Raises:
        InputError: names the field that lacks, is unknown or has the wrong type.
    """
    try:
        return _reader(kind)(plain)
    except InputError as error:
        raise _inside(where or kind.__name__, error) from None


def _packb(value: Any) -> bytes:
    packed = msgpack.packb(value, default=_packable, use_bin_type=True)
    assert packed is not None
    return packed


def _lists(plain: Any) -> Any:
    if isinstance(plain, np.ndarray):
        return plain.tolist()
    if isinstance(plain, dict):
        return {key: _lists(item) for key, item in plain.items()}
    if isinstance(plain, list):
        return [_lists(item) for item in plain]
    return plain


def _packable(value: Any) -> Any:
    """What msgpack does not know itself, one level of it: it asks again for what is inside."""
    if isinstance(value, np.ndarray):
        return msgpack.ExtType(_ARRAY_CODE, _array_head(value.dtype, value.shape) + value.tobytes())
    if (names := _names(type(value))) is not None:
        return {name: getattr(value, name) for name in names}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot encode {type(value)}")


@lru_cache(maxsize=256)
def _array_head(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    name = dtype.newbyteorder("<").str
    assert name in _DTYPES, name
    return _packb([name, list(shape)])


def _unpack_array(code: int, data: bytes) -> np.ndarray:
    if code != _ARRAY_CODE:
        raise InputError("message", f"unknown extension type {code}")
    unpacker = msgpack.Unpacker(raw=False, max_array_len=_MAX_AXES + 2)
    unpacker.feed(data[:64])
    try:
        dtype, shape = unpacker.unpack()
        if dtype not in _DTYPES or len(shape) > _MAX_AXES or min([*shape, 0]) < 0:
            raise ValueError(f"array of {dtype} with shape {shape}")
        array = np.frombuffer(data, np.dtype(dtype), offset=unpacker.tell())
        return array.reshape(shape)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise InputError("message", f"an array that cannot be read ({error})") from None


@cache
def _fields(kind: type) -> dict[str, tuple[Any, bool]]:
    """Name, type and whether it is required, of every field."""
    hints = typing.get_type_hints(kind)
    missing = dataclasses.MISSING
    return {
        f.name: (hints[f.name], f.default is missing and f.default_factory is missing)
        for f in dataclasses.fields(kind)
    }


@cache
def _names(kind: type) -> tuple[str, ...] | None:
    """A dataclass's fields; None of any other type."""
    if not dataclasses.is_dataclass(kind):
        return None
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _reader(kind: Any) -> Callable[[Any], Any]:
    """How values of a type are read; found out once, as every frame has dozens of them.

    Readers raise InputErrors whose field is the way from the value that they were given.
    """
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _dataclass_reader(typing.cast(type, kind))
    if origin in (typing.Union, types.UnionType):
        return _optional_reader(options)
    if origin is tuple:
        return partial(_read_tuple, _reader(options[0]))
    if origin is dict:
        return partial(_read_dict, _reader(options[1]))
    if origin is np.ndarray:
        return partial(_read_array, np.dtype(typing.get_args(options[1])[0]))
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return partial(_read_enum, kind)
    return partial(_read_scalar, kind)


def _dataclass_reader(kind: type) -> Callable[[Any], Any]:
    fields = {
        name: (_reader(hint), is_required) for name, (hint, is_required) in _fields(kind).items()
    }

    def read(value: Any) -> Any:
        if not isinstance(value, dict):
            raise InputError("", f"must be a map of fields, got {_name(value)}")
        if unknown := value.keys() - fields.keys():
            first = min(str(key) for key in unknown)
            raise InputError(f".{first}", f"unknown field; known are {', '.join(fields)}")
        arguments, name = {}, ""
        try:
            for name, (read_field, is_required) in fields.items():
                if name in value:
                    arguments[name] = read_field(value[name])
                elif is_required:
                    raise InputError("", "is missing")
        except InputError as error:
            raise _inside(f".{name}", error) from None
        return kind(**arguments)

    return read


def _inside(where: str, error: InputError) -> InputError:
    return InputError(f"{where}{error.field}", error.reason)


def _optional_reader(options: tuple[Any, ...]) -> Callable[[Any], Any]:
    (kind,) = (option for option in options if option is not types.NoneType)
    read = _reader(kind)
    return lambda value: None if value is None else read(value)


def _read_tuple(read: Callable[[Any], Any], value: Any) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise InputError("", f"must be a list, got {_name(value)}")
    items: list[Any] = []
    try:
        for item in value:
            items.append(read(item))
    except InputError as error:
        raise _inside(f"[{len(items)}]", error) from None
    return tuple(items)


def _read_dict(read: Callable[[Any], Any], value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError("", f"must be a map, got {_name(value)}")
    items: dict[str, Any] = {}
    key: Any = ""
    try:
        for key, item in value.items():
            items[str(key)] = read(item)
    except InputError as error:
        raise _inside(f".{key}", error) from None
    return items


def _read_array(dtype: np.dtype, value: Any) -> np.ndarray:
    if isinstance(value, list):
        try:
            value = np.asarray(value, dtype)
        except (ValueError, TypeError, OverflowError):
            raise InputError("", "must be numbers in rows of equal length") from None
    if not isinstance(value, np.ndarray):
        raise InputError("", f"must be an array, got {_name(value)}")
    if value.dtype != dtype:
        raise InputError("", f"must be an array of {dtype}, got {value.dtype}")
    return value


def _read_enum(kind: type[StrEnum], value: Any) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(str(member) for member in kind)
        raise InputError("", f"must be one of {known}, got {str(value)[:40]!r}") from None


def _read_scalar(kind: Any, value: Any) -> Any:
    if type(value) is kind:
        return value
    if kind is not float or type(value) is not int:
        raise InputError("", f"must be {kind.__name__}, got {_name(value)}")
    try:
        return float(value)
    except OverflowError:
        raise InputError("", "is too large a number") from None


def _name(value: Any) -> str:
    return "nothing" if value is None else type(value).__name__
