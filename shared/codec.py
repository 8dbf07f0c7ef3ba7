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
from functools import cache, partial
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
    return _packb(to_plain(message))


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
    plain = to_plain(value)
    return _lists(plain)


def from_plain(kind: type[T], plain: Any, where: str = "") -> T:
    """Build a dataclass from dictionaries.

    Raises:
        InputError: names the field that lacks, is unknown or has the wrong type.
    """
    return _convert(kind, plain, where or kind.__name__)


def _packb(plain: Any) -> bytes:
    packed = msgpack.packb(plain, default=_pack_array, use_bin_type=True)
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


def _pack_array(value: Any) -> msgpack.ExtType:
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        dtype = array.dtype.newbyteorder("<").str
        assert dtype in _DTYPES, dtype
        head = _packb([dtype, list(value.shape)])
        return msgpack.ExtType(_ARRAY_CODE, head + array.tobytes())
    raise TypeError(f"cannot encode {type(value)}")


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


def _convert(kind: Any, value: Any, where: str) -> Any:
    return _converter(kind)(value, where)


@cache
def _converter(kind: Any) -> Callable[[Any, str], Any]:
    """How values of a type are read: looked at once, as every frame has dozens of them."""
    origin = typing.get_origin(kind)
    if dataclasses.is_dataclass(kind):
        return partial(_convert_dataclass, typing.cast(type, kind))
    if origin in (typing.Union, types.UnionType):
        return partial(_convert_optional, typing.get_args(kind))
    if origin is tuple:
        return partial(_convert_tuple, typing.get_args(kind))
    if origin is dict:
        return partial(_convert_dict, typing.get_args(kind))
    if origin is np.ndarray:
        return partial(_convert_array, np.dtype(typing.get_args(typing.get_args(kind)[1])[0]))
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return partial(_convert_enum, kind)
    return partial(_convert_scalar, kind)


def _convert_dataclass(kind: type, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise InputError(where, f"must be a map of fields, got {_name(value)}")
    fields = _fields(kind)
    if unknown := value.keys() - fields.keys():
        first = min(str(key) for key in unknown)
        raise InputError(f"{where}.{first}", f"unknown field; known are {', '.join(fields)}")
    arguments = {}
    for name, (hint, is_required) in fields.items():
        if name in value:
            arguments[name] = _convert(hint, value[name], f"{where}.{name}")
        elif is_required:
            raise InputError(f"{where}.{name}", "is missing")
    return kind(**arguments)


def _convert_optional(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and types.NoneType in options:
        return None
    (kind,) = (option for option in options if option is not types.NoneType)
    return _convert(kind, value, where)


def _convert_tuple(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if not isinstance(value, list | tuple):
        raise InputError(where, f"must be a list, got {_name(value)}")
    return tuple(_convert(options[0], item, f"{where}[{i}]") for i, item in enumerate(value))


def _convert_dict(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise InputError(where, f"must be a map, got {_name(value)}")
    return {str(key): _convert(options[1], item, f"{where}.{key}") for key, item in value.items()}


def _convert_array(dtype: np.dtype, value: Any, where: str) -> np.ndarray:
    if isinstance(value, list):
        try:
            value = np.asarray(value, dtype)
        except (ValueError, TypeError, OverflowError):
            raise InputError(where, "must be numbers in rows of equal length") from None
    if not isinstance(value, np.ndarray):
        raise InputError(where, f"must be an array, got {_name(value)}")
    if value.dtype != dtype:
        raise InputError(where, f"must be an array of {dtype}, got {value.dtype}")
    return value


def _convert_enum(kind: type[StrEnum], value: Any, where: str) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(str(member) for member in kind)
        raise InputError(where, f"must be one of {known}, got {str(value)[:40]!r}") from None


def _convert_scalar(kind: Any, value: Any, where: str) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return _float(value, where)
    if type(value) is not kind:
        raise InputError(where, f"must be {kind.__name__}, got {_name(value)}")
    return value


def _float(value: int, where: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise InputError(where, "is too large a number") from None


def _name(value: Any) -> str:
    return "nothing" if value is None else type(value).__name__
