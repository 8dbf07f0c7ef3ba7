"""A sequence as a bad day would deliver it: repeats, losses, black depth, another place.

Frames are played to and fro until there are enough of them, so that any sequence will do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.camera import Calibration
from shared.frames import DepthEncoding, Frame
from shared.images import decode_colour, decode_depth, encode_depth, encode_jpeg
from shared.se3 import inverse


class Sequence(Protocol):
    """Frames with their true poses, as `benchmarks.true_sequence.TrueSequence` has them."""

    calibration: Calibration

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """One frame."""
        ...

    def true_pose(self, index: int) -> NDArray[np.float64]:
        """T_world_camera, [4, 4]."""
        ...


@dataclass(frozen=True)
class Plan:
    """What goes wrong, and when; counts are of frames."""

    frames: int = 500
    repeat_every: int = 7  # sent twice
    drop_every: int = 50
    black_every: int = 10  # the whole depth image is black
    black_share: float = 0.1  # of every other depth image, in patches
    away_from: int = 300  # the camera is elsewhere from here on
    away_for: int = 60  # two seconds at 30 Hz
    period_ns: int = 33_000_000
    seed: int = 0


@dataclass(frozen=True)
class Sent:
    """A frame as it is sent, and what it shows: an index of the sequence, None for elsewhere."""

    frame: Frame
    index: int | None
    is_repeat: bool = False


def disturbed(sequence: Sequence, elsewhere: Sequence, plan: Plan) -> Iterator[Sent]:
    """The frames of a sequence with everything of the plan done to them."""
    rng = np.random.default_rng(plan.seed)
    shown = Sent(_holed(sequence, 0, plan, rng), 0)
    step = 0
    for seq in range(plan.frames):
        if plan.away_from <= seq < plan.away_from + plan.away_for:
            yield _elsewhere(sequence, elsewhere, seq, plan)
            continue
        is_repeat = seq % plan.repeat_every == plan.repeat_every - 1
        if not is_repeat:
            shown = Sent(_holed(sequence, step, plan, rng), to_and_fro(step, len(sequence)))
            step += 1
        if seq % plan.drop_every != plan.drop_every - 1:
            yield Sent(_stamped(shown.frame, seq, plan), shown.index, is_repeat)


def to_and_fro(step: int, length: int) -> int:
    """Index of a sequence that is played forwards, backwards, forwards, ..."""
    step %= max(1, 2 * length - 2)
    return step if step < length else 2 * length - 2 - step


class MovingBox:
    """A sequence with a textured box before the camera that covers a third of it and moves."""

    def __init__(self, sequence: Sequence, depth_m: float = 1.8, step_px: float = 6.0) -> None:
        self.calibration = sequence.calibration
        self._sequence = sequence
        self._depth_m = depth_m
        self._step_px = step_px

    def __len__(self) -> int:
        return len(self._sequence)

    def true_pose(self, index: int) -> NDArray[np.float64]:
        """T_world_camera, [4, 4]."""
        return self._sequence.true_pose(index)

    def frame(self, index: int) -> Frame:
        """One frame; the box sweeps from side to side with the index."""
        frame, size = self._sequence.frame(index), self.calibration.colour.intrinsics
        rgb = decode_colour(frame.rgb, size).copy()
        depth_m = decode_depth(frame.depth, self.calibration)
        height, width = int(0.75 * size.height), int(0.44 * size.width)
        left = to_and_fro(round(index * self._step_px), size.width - width)
        top = (size.height - height) // 2
        box = np.s_[top : top + height, left : left + width]
        rgb[box] = _texture(height, width)
        depth_m[box] = self._front_m(index)[box]
        with_box = dataclasses.replace(frame, rgb=encode_jpeg(rgb, 95))
        return _with_depth(with_box, depth_m, self.calibration)

    def _front_m(self, index: int) -> NDArray[np.float64]:
        """Depth of the plane that the box slides along, [H, W]: it stands in the world."""
        T = inverse(self.true_pose(0)) @ self.true_pose(index)
        i = self.calibration.colour.intrinsics
        u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
        rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1)
        return np.maximum(self._depth_m - T[2, 3], 0.5) / np.maximum(rays @ T[2, :3], 0.1)


class CarriedPlane:
    """A sequence filmed past a textured board that is fixed to the camera and hides a share of it.

    Nothing of the board's image changes but that it appears: in depth and colour it says that the
    camera stands still.
    """

    def __init__(
        self, sequence: Sequence, share: float = 0.36, depth_m: float = 0.6, from_index: int = 0
    ) -> None:
        self.calibration = sequence.calibration
        self._sequence = sequence
        self._side = float(np.sqrt(share))
        self._depth_m = depth_m
        self._from_index = from_index

    def __len__(self) -> int:
        return len(self._sequence)

    def true_pose(self, index: int) -> NDArray[np.float64]:
        """T_world_camera, [4, 4]."""
        return self._sequence.true_pose(index)

    def frame(self, index: int) -> Frame:
        """One frame; the board is in the middle of it, tilted by a few degrees."""
        frame, size = self._sequence.frame(index), self.calibration.colour.intrinsics
        if index < self._from_index:
            return frame
        rgb = decode_colour(frame.rgb, size).copy()
        depth_m = decode_depth(frame.depth, self.calibration)
        height, width = int(self._side * size.height), int(self._side * size.width)
        left, top = (size.width - width) // 2, (size.height - height) // 2
        board = np.s_[top : top + height, left : left + width]
        rgb[board] = _texture(height, width)
        depth_m[board] = self._depth_m / (1.0 + 0.1 * np.linspace(-1.0, 1.0, width))
        return _with_depth(
            dataclasses.replace(frame, rgb=encode_jpeg(rgb, 95)), depth_m, self.calibration
        )


def _texture(height: int, width: int) -> NDArray[np.uint8]:
    """The box's side: random squares, always the same."""
    cells = np.random.default_rng(7).integers(0, 256, (height // 9 + 1, width // 9 + 1, 3))
    return np.kron(cells, np.ones((9, 9, 1), np.int64))[:height, :width].astype(np.uint8)


def _stamped(frame: Frame, seq: int, plan: Plan) -> Frame:
    return dataclasses.replace(frame, seq=seq, t_ns=seq * plan.period_ns, may_be_keyframe=True)


def _black(
    shape: tuple[int, ...], step: int, plan: Plan, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Pixels without depth: all of them, or patches of a sixth of the image's sides."""
    if step % plan.black_every == plan.black_every - 1:
        return np.ones(shape, np.bool_)
    black = np.zeros(shape, np.bool_)
    height, width = shape[0] // 6, shape[1] // 6
    while black.mean() < plan.black_share:
        v, u = rng.integers(shape[0] - height), rng.integers(shape[1] - width)
        black[v : v + height, u : u + width] = True
    return black


def _holed(sequence: Sequence, step: int, plan: Plan, rng: np.random.Generator) -> Frame:
    """A frame of the sequence that lacks some of its depth."""
    frame = sequence.frame(to_and_fro(step, len(sequence)))
    depth_m = decode_depth(frame.depth, sequence.calibration)
    depth_m[_black(depth_m.shape, step, plan, rng)] = 0.0
    return _with_depth(frame, depth_m, sequence.calibration)


def _with_depth(frame: Frame, depth_m: NDArray[np.float32], calibration: Calibration) -> Frame:
    raw = np.round(depth_m * calibration.depth_scale).astype(np.uint16)
    return dataclasses.replace(frame, depth=encode_depth(raw, DepthEncoding.RAW16))


def _elsewhere(sequence: Sequence, elsewhere: Sequence, seq: int, plan: Plan) -> Sent:
    """A frame of another sequence in this one's size and depth scale."""
    other = elsewhere.frame(to_and_fro(seq - plan.away_from, len(elsewhere)))
    size = sequence.calibration.colour.intrinsics
    rgb = decode_colour(other.rgb, elsewhere.calibration.colour.intrinsics)
    rgb = cv2.resize(rgb, (size.width, size.height)).astype(np.uint8)
    depth_m = decode_depth(other.depth, elsewhere.calibration)
    depth_m = cv2.resize(depth_m, (size.width, size.height), interpolation=cv2.INTER_NEAREST)
    frame = dataclasses.replace(other, rgb=encode_jpeg(rgb))
    frame = _with_depth(frame, np.asarray(depth_m, np.float32), sequence.calibration)
    return Sent(_stamped(frame, seq, plan), None)
