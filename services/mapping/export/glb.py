"""Binary glTF 2.0: one primitive from named arrays."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Attribute = NDArray[np.number]  # float32, uint32 or uint8

POINTS, TRIANGLES = 0, 4  # modes of a primitive
_GENERATOR = "PointSLAM++"
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint8": 5121}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view


@dataclass(frozen=True)
class Primitive:
    """What is drawn: attributes [N] or [N, K] by name, whole bytes meaning 0 to 1."""

    mode: int
    attributes: Mapping[str, Attribute]
    indices: NDArray[np.uint32] | None = None
    extensions: Mapping[str, Any] = field(default_factory=dict)


def glb_bytes(primitive: Primitive) -> bytes:
    """A file with one scene of one node; positions in metres, y up."""
    buffer = _Buffer()
    accessors = {name: buffer.add(array, name) for name, array in primitive.attributes.items()}
    drawn: dict[str, Any] = {"mode": primitive.mode, "attributes": accessors}
    if primitive.indices is not None:
        drawn["indices"] = buffer.add(primitive.indices.reshape(-1), "")
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": _GENERATOR}}
    if primitive.extensions:
        drawn["extensions"] = dict(primitive.extensions)
        document["extensionsUsed"] = sorted(primitive.extensions)
    document |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    document |= {"meshes": [{"primitives": [drawn]}], **buffer.document()}
    return _container(json.dumps(document).encode(), buffer.content())


class _Buffer:
    """Arrays one after the other, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: Attribute, name: str) -> int:
        """Take an array; returns the number of its accessor."""
        content = array.tobytes()
        target = _VERTICES if name else _INDICES
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(content)}
        self._views.append({**view, "target": target})
        self._parts.append(content + bytes(-len(content) % 4))
        self._length += len(self._parts[-1])
        self._accessors.append({"bufferView": len(self._views) - 1, **_accessor(array, name)})
        return len(self._accessors) - 1

    def document(self) -> dict[str, Any]:
        """The entries that say where each array lies."""
        buffers = [{"byteLength": self._length}]
        return {"buffers": buffers, "bufferViews": self._views, "accessors": self._accessors}

    def content(self) -> bytes:
        """All arrays."""
        return b"".join(self._parts)


def _accessor(array: Attribute, name: str) -> dict[str, Any]:
    width = array.shape[1] if array.ndim == 2 else 1
    kind = array.dtype.name
    entry: dict[str, Any] = {"componentType": _COMPONENTS[kind], "count": len(array)}
    entry["type"] = _TYPES[width]
    if kind == "uint8":
        entry["normalized"] = True
    if name == "POSITION":  # the format asks for its bounds
        entry |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
    return entry


def _container(document: bytes, content: bytes) -> bytes:
    document += b" " * (-len(document) % 4)
    total = 12 + 8 + len(document) + 8 + len(content)
    header = struct.pack("<III", _MAGIC, 2, total)
    chunks = struct.pack("<II", len(document), _JSON) + document
    return header + chunks + struct.pack("<II", len(content), _BINARY) + content
