"""Where the frames of an MCAP file lie in each other: Foxglove's transforms and ROS 2's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from shared import se3
from shared.se3 import Matrix

SCHEMAS = frozenset({"foxglove.FrameTransform", "tf2_msgs/msg/TFMessage"})
_MAX_DEPTH = 64  # of a tree of frames; a longer chain is a ring


class FrameTree:
    """Frames by their parents, each as it was first told."""

    def __init__(self, told: Iterable[tuple[str, Any]]) -> None:
        """Read messages of `SCHEMAS`, each with the name of its schema."""
        self._parents: dict[str, tuple[str, Matrix]] = {}
        for schema, message in told:
            for child, parent, T_parent_child in _edges(schema, message):
                self._parents.setdefault(child, (parent, T_parent_child))

    def between(self, target: str, source: str) -> Matrix | None:
        """`T_target_source`, or None where nothing joins the two."""
        to_target = dict(self._ancestors(target))
        for frame, T_frame_source in self._ancestors(source):
            if frame in to_target:
                return se3.inverse(to_target[frame]) @ T_frame_source
        return None

    def _ancestors(self, frame: str) -> Iterator[tuple[str, Matrix]]:
        """The frame and all above it, with the transform from the frame to each."""
        T = np.eye(4)
        yield frame, T
        for _ in range(_MAX_DEPTH):
            if frame not in self._parents:
                return
            frame, T_parent_child = self._parents[frame]
            T = T_parent_child @ T
            yield frame, T


def _edges(schema: str, message: Any) -> Iterator[tuple[str, str, Matrix]]:
    """Child, parent and `T_parent_child` of every transform in a message."""
    if schema == "foxglove.FrameTransform":
        T = _matrix(message.translation, message.rotation)
        yield message.child_frame_id, message.parent_frame_id, T
        return
    for told in message.transforms:
        T = _matrix(told.transform.translation, told.transform.rotation)
        yield told.child_frame_id, told.header.frame_id, T


def _matrix(translation: Any, rotation: Any) -> Matrix:
    t, q = translation, rotation
    return se3.from_quat_xyzw([q.x, q.y, q.z, q.w], [t.x, t.y, t.z])
