"""What a recorded RGB-D sequence is, whatever its format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from shared.camera import Calibration, Intrinsics
from shared.errors import ConfigError, InputError, SequenceError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, DepthImage
from shared.images import decode_colour, decode_depth
from shared.se3 import Matrix

_JPEG, _PNG = b"\xff\xd8", b"\x89PNG"
_DEFAULT_RATE_HZ = 30.0


@dataclass(frozen=True)
class SequenceOptions:
    """How to read a sequence where its format leaves a choice.

    `depth_scale` (units per metre) replaces the format's own: 5208 is the other published
    calibration of TUM fr2. `raw_depth` takes a folder's unregistered depth camera.
    """

    max_association_s: float = 0.02
    depth_scale: float | None = None
    raw_depth: bool = False
    colour_topic: str | None = None  # of an MCAP file with several
    depth_topic: str | None = None

    def __post_init__(self) -> None:
        if not 0 < self.max_association_s <= 1:
            raise ConfigError(f"max_association_s must be 0 to 1, got {self.max_association_s}")
        if self.depth_scale is not None and not 1 <= float(self.depth_scale) <= 1e6:
            raise ConfigError(f"depth_scale must be 1 to 1e6, got {self.depth_scale}")


@dataclass(frozen=True)
class SequenceFrame:
    """One frame as recorded: the bytes of its image files, untouched, and its true pose if known.

    Frames of a video have no bytes of their own; they are encoded anew.
    """

    t_ns: int
    stamp: str  # as the sequence's own files spell it
    rgb: ColourImage
    depth: DepthImage
    T_world_camera: Matrix | None


@dataclass(frozen=True)
class View:
    """A view off the trajectory, for scoring what the map shows from new places."""

    t_ns: int
    rgb: ColourImage
    depth: DepthImage | None
    T_world_camera: Matrix


class Sequence(Protocol):
    """A recording that can be streamed: frames in order of their stamps."""

    @property
    def name(self) -> str:
        """A short name for tables."""
        ...

    @property
    def calibration(self) -> Calibration:
        """The device; its colour camera is the one that poses belong to."""
        ...

    @property
    def rate_hz(self) -> float:
        """Frames a second when it was recorded."""
        ...

    @property
    def num_views(self) -> int:
        """How many views off the trajectory there are."""
        ...

    def __len__(self) -> int: ...

    def frame(self, index: int) -> SequenceFrame:
        """Read one frame; raises SequenceError naming the file that cannot be read."""
        ...

    def stamp(self, index: int) -> str:
        """A frame's stamp as the sequence's own files spell it."""
        ...

    def t_ns(self, index: int) -> int:
        """A frame's stamp in nanoseconds."""
        ...

    def truth(self, index: int) -> Matrix | None:
        """`T_world_camera` of a frame without reading its images."""
        ...

    def view(self, index: int) -> View:
        """Read one view off the trajectory."""
        ...


@dataclass(frozen=True)
class FrameFiles:
    """Where one frame lies; `number` where its files hold many frames."""

    t_ns: int
    stamp: str
    rgb: Path
    depth: Path | None
    T_world_camera: Matrix | None
    number: int = 0


class FrameReader(Protocol):
    """Gets a frame's images out of its files; raises SequenceError naming the file."""

    def colour(self, files: FrameFiles) -> ColourImage:
        """The encoded colour image."""
        ...

    def depth(self, files: FrameFiles) -> DepthImage:
        """The encoded depth image of a frame that has one."""
        ...


class ImageFiles:
    """One image a file, whose bytes pass through untouched."""

    def colour(self, files: FrameFiles) -> ColourImage:
        """The bytes of the colour file."""
        return read_colour(files.rgb)

    def depth(self, files: FrameFiles) -> DepthImage:
        """The bytes of the depth file."""
        assert files.depth is not None
        return read_depth(files.depth)


@dataclass(frozen=True)
class FileSequence:
    """A sequence of image files; every format is read into one of these.

    Raises:
        SequenceError: no frames, a file is absent, stamps do not grow, or the first frame does
            not fit the calibration.
    """

    name: str
    path: Path
    calibration: Calibration
    frames: tuple[FrameFiles, ...]
    views: tuple[FrameFiles, ...] = ()
    reader: FrameReader = ImageFiles()

    def __post_init__(self) -> None:
        if not self.frames:
            raise SequenceError(self.path, "holds no frame with both colour and depth")
        _check_calibration(self.path, self.calibration)
        _check_files(self.frames + self.views)
        _check_stamps(self.path, self.frames)
        _check_first(self)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def num_views(self) -> int:
        """How many views off the trajectory there are."""
        return len(self.views)

    @property
    def rate_hz(self) -> float:
        """Frames a second, by the median step between stamps."""
        if len(self) < 2:
            return _DEFAULT_RATE_HZ
        return 1e9 / float(np.median(np.diff([f.t_ns for f in self.frames])))

    def stamp(self, index: int) -> str:
        """A frame's stamp as the sequence's own files spell it."""
        return self.frames[index].stamp

    def t_ns(self, index: int) -> int:
        """A frame's stamp in nanoseconds."""
        return self.frames[index].t_ns

    def truth(self, index: int) -> Matrix | None:
        """`T_world_camera` of a frame, where the sequence knows it."""
        return self.frames[index].T_world_camera

    def frame(self, index: int) -> SequenceFrame:
        """Read one frame's files."""
        files = self.frames[index]
        colour, depth = self.reader.colour(files), self.reader.depth(files)
        return SequenceFrame(files.t_ns, files.stamp, colour, depth, files.T_world_camera)

    def view(self, index: int) -> View:
        """Read one view's files."""
        files = self.views[index]
        assert files.T_world_camera is not None
        depth = self.reader.depth(files) if files.depth is not None else None
        return View(files.t_ns, self.reader.colour(files), depth, files.T_world_camera)


def is_held_out(index: int, holdout: int) -> bool:
    """Whether frame `index` is kept from training: one of every `holdout`; 0 keeps none."""
    return holdout > 0 and index % holdout == holdout // 2


def read_colour(path: Path) -> ColourImage:
    """A colour file's bytes; SequenceError if it is neither JPEG nor PNG."""
    data = _read(path)
    if data.startswith(_JPEG):
        return ColourImage(ColourEncoding.JPEG, data)
    if data.startswith(_PNG):
        return ColourImage(ColourEncoding.PNG, data)
    raise SequenceError(path, "is neither a JPEG nor a PNG image")


def read_depth(path: Path) -> DepthImage:
    """A depth file's bytes; SequenceError if it is no PNG."""
    data = _read(path)
    if not data.startswith(_PNG):
        raise SequenceError(path, "is no PNG image; depth must be a 16 bit PNG")
    return DepthImage(DepthEncoding.PNG16, data)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file."""
    image = cv2.imdecode(np.frombuffer(_read(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise SequenceError(path, "does not decode as an image")
    return image.shape[1], image.shape[0]


def depth_intrinsics(colour: Intrinsics, depth_size: tuple[int, int]) -> Intrinsics | None:
    """The colour camera at the depth image's resolution; None when they are the same."""
    if depth_size == (colour.width, colour.height):
        return None
    return colour.scaled(depth_size[0] / colour.width)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SequenceError(path, f"cannot be read ({error.strerror})") from None


def _check_calibration(path: Path, calibration: Calibration) -> None:
    try:
        calibration.check()
    except InputError as error:
        raise SequenceError(path, str(error)) from None


def _check_files(frames: tuple[FrameFiles, ...]) -> None:
    for frame in frames:
        for path in (frame.rgb, frame.depth):
            if path is not None and not path.is_file():
                raise SequenceError(path, "is listed but absent")


def _check_stamps(path: Path, frames: tuple[FrameFiles, ...]) -> None:
    for before, after in zip(frames, frames[1:], strict=False):
        if after.t_ns <= before.t_ns:
            raise SequenceError(path, f"stamps must grow, but {after.stamp} follows {before.stamp}")


def _check_first(sequence: FileSequence) -> None:
    files, frame = sequence.frames[0], sequence.frame(0)
    try:
        decode_colour(frame.rgb, sequence.calibration.colour.intrinsics)
    except InputError as error:
        raise SequenceError(files.rgb, error.reason) from None
    try:
        decode_depth(frame.depth, sequence.calibration)
    except InputError as error:
        raise SequenceError(files.depth, error.reason) from None
