"""MCAP recordings: our own, and those of ROS 2 with colour, depth and camera information.

Needs the extra `mcap`. The colour topic is the one with colour images, the depth topic the one
with distances; where there are several, `SequenceOptions` names one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets import mcap_messages as messages
from pointslam.datasets.base import FileSequence, FrameFiles, SequenceOptions
from pointslam.datasets.lists import associate, nearest
from pointslam.datasets.mcap_transforms import SCHEMAS, FrameTree
from shared.camera import Calibration, Camera
from shared.errors import ConfigError, InputError, SequenceError
from shared.frames import ColourImage, DepthImage
from shared.se3 import Matrix

METADATA = "pointslam"  # record with the scale of depth
TRUTH_TOPIC = "/truth"
INSTALL = "reading and writing MCAP needs: pip install 'pointslam[mcap]'"
_MILLIMETRES = 1000.0  # what 16UC1 means to ROS


def is_mcap(path: Path) -> bool:
    """Whether this is such a file, by its name."""
    return path.is_file() and path.suffix == ".mcap"


def read_mcap(path: Path, options: SequenceOptions) -> FileSequence:
    """Read a file; frames take their colour image's stamp."""
    recording = Recording(path)
    colour = recording.image_topic("colour", options.colour_topic)
    depth = recording.image_topic("depth", options.depth_topic)
    times = recording.stamps(colour), recording.stamps(depth)
    stamps = [[t_ns for t_ns, _ in found] for found in times]
    gap_ns = round(options.max_association_s * 1e9)
    pairs = associate(stamps[0], stamps[1], gap_ns)
    truth = recording.poses()
    frames = []
    for number, (i, _) in enumerate(pairs):
        at = nearest([t_ns for t_ns, _ in truth], stamps[0][i], gap_ns)
        T, t_ns = None if at is None else truth[at][1], stamps[0][i]
        stamp = f"{t_ns // 10**9}.{t_ns % 10**9:09d}"
        frames.append(FrameFiles(t_ns, stamp, path, path, T, number))
    logged = [(times[0][i][1], times[1][j][1]) for i, j in pairs]
    calibration = recording.calibration(colour, depth, options.depth_scale)
    reader = _Images(recording, colour, depth, tuple(logged))
    return FileSequence(path.stem, path, calibration, tuple(frames), reader=reader)


class Recording:
    """One file: its topics, and messages by the time that they were logged at.

    Raises:
        ConfigError: the packages are not installed.
        SequenceError: the file is damaged or not MCAP.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.exceptions import McapError
            from mcap.reader import make_reader
            from mcap_protobuf.decoder import DecoderFactory as Protobuf
            from mcap_ros2.decoder import DecoderFactory as Ros2
        except ImportError as error:
            raise ConfigError(f"{INSTALL} ({error})") from None
        self.path = path
        self._file = path.open("rb")
        self._factories = (Protobuf(), Ros2())
        try:
            self._reader = make_reader(self._file)
            summary = self._reader.get_summary()
            kept = {record.name: record.metadata for record in self._reader.iter_metadata()}
        except (McapError, ValueError, EOFError) as error:
            raise SequenceError(path, f"is no whole MCAP file ({error})") from None
        if summary is None:
            raise SequenceError(path, "has no summary: `mcap recover` mends a torn file")
        self._metadata = kept.get(METADATA, {})
        self._topics = {
            channel.topic: (channel.message_encoding, summary.schemas[channel.schema_id])
            for channel in summary.channels.values()
            if channel.schema_id in summary.schemas
        }

    def image_topic(self, what: str, wanted: str | None) -> str:
        """The topic with colour or depth images.

        Raises:
            SequenceError: there is none, or several and none of them is named.
        """
        images = self._of(messages.IMAGES)
        fitting = [t for t in images if self._first_image(t).is_depth == (what == "depth")]
        if wanted is not None and wanted in fitting:
            return wanted
        if wanted is None and len(fitting) == 1:
            return fitting[0]
        has = ", ".join(fitting) if fitting else f"none (topics: {', '.join(self._topics)})"
        name_one = f"name one with --set sequence.{what}_topic=TOPIC"
        problem = f"{wanted} is none of them" if wanted else name_one
        raise SequenceError(self.path, f"topics with {what} images: {has}; {problem}")

    def stamps(self, topic: str) -> list[tuple[int, int]]:
        """Time of the image and time of logging of every message, ascending."""
        stamp = messages.stamp_reader(self._schema(topic), self._decoder(topic))
        found = self._reader.iter_messages(topics=[topic])
        return sorted((stamp(message.data), message.log_time) for _, _, message in found)

    def image(self, topic: str, log_time: int) -> messages.ImageMessage:
        """The image that was logged at a time."""
        for data in self._data(topic, log_time):
            return messages.image_message(self._schema(topic), self._decoder(topic)(data))
        raise SequenceError(self.path, f"{topic} has no message at {log_time}")

    def poses(self) -> list[tuple[int, Matrix]]:
        """Time and `T_world_camera` of every true pose; [] where there are none."""
        if TRUTH_TOPIC not in self._of(messages.POSES):
            return []
        decode = self._decoder(TRUTH_TOPIC)
        return sorted((messages.pose_of(decode(d)) for d in self._data(TRUTH_TOPIC)), key=_time)

    def calibration(self, colour: str, depth: str, depth_scale: float | None) -> Calibration:
        """The device, by the frames that its images are in.

        Raises:
            SequenceError: a camera is not described, or nothing joins depth's frame to colour's.
        """
        images = self._first_image(colour), self._first_image(depth)
        T_colour_depth = self._tree().between(images[0].frame_id, images[1].frame_id)
        if T_colour_depth is None:
            frames = f"depth is in frame {images[1].frame_id!r}, colour in {images[0].frame_id!r}"
            advice = "record depth aligned to colour, or the transforms"
            raise SequenceError(self.path, f"{frames}, and nothing joins them: {advice}")
        camera = self._camera(colour, images[0].frame_id)
        kept = json.loads(self._metadata.get("calibration", "{}"))
        is_float = images[1].encoding == "32FC1"
        usual = messages.FLOAT_DEPTH_SCALE if is_float else kept.get("depth_scale", _MILLIMETRES)
        calibration = Calibration(camera, float(depth_scale or usual))
        own = self._camera(depth, images[1].frame_id)
        if own == camera and np.array_equal(T_colour_depth, np.eye(4)):
            return calibration
        return replace(calibration, depth=own, T_colour_depth=T_colour_depth)

    def _tree(self) -> FrameTree:
        topics = self._of(SCHEMAS)
        decoders = {topic: (self._schema(topic), self._decoder(topic)) for topic in topics}
        return FrameTree(
            (schema, decode(data))
            for topic, (schema, decode) in decoders.items()
            for data in self._data(topic)
        )

    def _camera(self, topic: str, frame_id: str) -> Camera:
        """The calibration whose topic is most alike, of those of the frame."""
        best: tuple[int, Camera] | None = None
        for candidate in self._of(messages.CALIBRATIONS):
            data = next(self._data(candidate), None)
            if data is None:
                continue
            frame, camera = messages.camera_of(
                self._schema(candidate), self._decoder(candidate)(data)
            )
            alike = _common(candidate, topic) if frame == frame_id else -1
            if alike >= 0 and (best is None or alike > best[0]):
                best = alike, camera
        if best is None:
            raise SequenceError(self.path, f"no camera information for frame {frame_id!r}")
        return best[1]

    def _first_image(self, topic: str) -> messages.ImageMessage:
        for data in self._data(topic):
            return messages.image_message(self._schema(topic), self._decoder(topic)(data))
        return messages.ImageMessage(0, "", "", b"")

    def _of(self, schemas: frozenset[str]) -> list[str]:
        return [t for t, (_, schema) in self._topics.items() if schema.name in schemas]

    def _schema(self, topic: str) -> str:
        return self._topics[topic][1].name

    def _data(self, topic: str, log_time: int | None = None) -> Iterator[bytes]:
        found = self._reader.iter_messages(topics=[topic], starting_at=log_time, ending_at=log_time)
        return (message.data for _, _, message in found)

    def _decoder(self, topic: str) -> Callable[[bytes], Any]:
        encoding, schema = self._topics[topic]
        for factory in self._factories:
            decoder = factory.decoder_for(encoding, schema)
            if decoder is not None:
                return decoder
        raise SequenceError(self.path, f"{topic}: messages in {encoding!r} cannot be read")


@dataclass(frozen=True)
class _Images:
    """Gets a frame's images out of the file by its number."""

    recording: Recording
    colour_topic: str
    depth_topic: str
    logged: tuple[tuple[int, int], ...]  # times of logging of colour and depth

    def colour(self, files: FrameFiles) -> ColourImage:
        """The encoded colour image."""
        return self._read(self.colour_topic, self.logged[files.number][0], messages.colour_image)

    def depth(self, files: FrameFiles) -> DepthImage:
        """The encoded depth image."""
        return self._read(self.depth_topic, self.logged[files.number][1], messages.depth_image)

    def _read(self, topic: str, log_time: int, convert: Callable[..., Any]) -> Any:
        try:
            return convert(self.recording.image(topic, log_time))
        except InputError as error:
            raise SequenceError(self.recording.path, f"{topic}: {error}") from None


def _common(a: str, b: str) -> int:
    """How many of their first characters are the same."""
    return len(os.path.commonprefix([a, b]))


def _time(entry: tuple[int, Matrix]) -> int:
    return entry[0]
