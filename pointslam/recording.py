"""Sequences and trajectories as MCAP files, which Foxglove opens and `pointslam run` replays.

Images are `foxglove.CompressedImage` (colour) and `foxglove.RawImage` (depth, 16UC1), so that its
3D panel shows them; poses are transforms of the frame `camera` in the frame `map`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from pointslam.datasets import Sequence, SequenceFrame, open_sequence
from pointslam.datasets.lists import read_trajectory
from pointslam.datasets.mcap import INSTALL, METADATA, TRUTH_TOPIC
from pointslam.progress import Progress, progress_bar
from shared.camera import Calibration, Camera
from shared.errors import ConfigError, SequenceError
from shared.frames import ColourEncoding, ColourImage
from shared.images import decode_colour, decode_depth, encode_jpeg
from shared.se3 import Matrix, Pose

COLOUR_TOPIC, DEPTH_TOPIC = "/camera/colour", "/camera/depth"
_MAP, _CAMERA, _NS = "map", "camera", 1_000_000_000


class Recorder:
    """An MCAP file that grows frame by frame; whole when it is left as a context.

    Raises:
        ConfigError: the packages are not installed.
    """

    def __init__(self, path: Path, calibration: Calibration) -> None:
        try:
            from mcap_protobuf.writer import Writer
        except ImportError as error:
            raise ConfigError(f"{INSTALL} ({error})") from None
        self._calibration = calibration
        is_apart = not np.array_equal(calibration.T_colour_depth, np.eye(4))
        self._depth_frame = "depth" if is_apart else _CAMERA
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        kept = {"depth_scale": calibration.depth_scale}
        self._writer.add_metadata(METADATA, {"calibration": json.dumps(kept)})

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.finish()
        self._file.close()

    def frame(self, frame: SequenceFrame, T_world_camera: Matrix | None = None) -> None:
        """Add a frame; with its estimated pose where there is one, and its true one.

        Raises:
            InputError: its images do not fit the calibration.
        """
        self._describe(frame.t_ns)
        self._write(f"{COLOUR_TOPIC}/image", self._colour(frame), frame.t_ns)
        self._write(f"{DEPTH_TOPIC}/image", self._depth(frame), frame.t_ns)
        shown = T_world_camera if T_world_camera is not None else frame.T_world_camera
        if shown is not None:
            self._write("/tf", _transform((_MAP, _CAMERA), shown, frame.t_ns), frame.t_ns)
        if frame.T_world_camera is not None:
            self._write(TRUTH_TOPIC, _pose(frame.T_world_camera, frame.t_ns), frame.t_ns)

    def _describe(self, t_ns: int) -> None:
        """Both cameras; where depth has a place of its own, that too."""
        device = self._calibration
        colour = _calibration(device.colour, _CAMERA, t_ns)
        depth = _calibration(device.depth_camera(), self._depth_frame, t_ns)
        self._write(f"{COLOUR_TOPIC}/calibration", colour, t_ns)
        self._write(f"{DEPTH_TOPIC}/calibration", depth, t_ns)
        if self._depth_frame != _CAMERA:
            frames = _CAMERA, self._depth_frame
            self._write("/tf_static", _transform(frames, device.T_colour_depth, t_ns), t_ns)

    def _write(self, topic: str, message: Any, t_ns: int) -> None:
        self._writer.write_message(topic, message, t_ns, t_ns)

    def _colour(self, frame: SequenceFrame) -> Any:
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        image = _compressed(frame.rgb, self._calibration)
        return CompressedImage(
            timestamp=_stamp(frame.t_ns),
            frame_id=_CAMERA,
            data=image.bytes,
            format=str(image.encoding),
        )

    def _depth(self, frame: SequenceFrame) -> Any:
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        depth_m = decode_depth(frame.depth, self._calibration)
        units = np.rint(depth_m * self._calibration.depth_scale).astype("<u2")
        height, width = units.shape
        return RawImage(
            timestamp=_stamp(frame.t_ns),
            frame_id=self._depth_frame,
            width=width,
            height=height,
            encoding="16UC1",
            step=2 * width,
            data=units.tobytes(),
        )


def record_sequence(
    sequence: Sequence, path: Path, estimated: Mapping[int, Matrix], progress: Progress
) -> None:
    """Write a whole sequence.

    Args:
        estimated: `T_world_camera` by t_ns, of the frames that have one.

    Raises:
        ConfigError: the packages are not installed.
        SequenceError: a frame cannot be read.
    """
    with Recorder(path, sequence.calibration) as recorder:
        for index in range(len(sequence)):
            frame = sequence.frame(index)
            recorder.frame(frame, estimated.get(frame.t_ns))
            progress(index + 1, len(sequence))


def convert_sequence(source: Path, target: Path, trajectory: Path | None) -> None:
    """Write a sequence of any format, with the poses of a TUM file where one is given.

    Raises:
        PointSlamError: see `record_sequence`; or the source is no sequence.
    """
    sequence = open_sequence(source)
    if trajectory is not None and not trajectory.is_file():
        raise SequenceError(trajectory, "does not exist")
    poses = read_trajectory(trajectory) if trajectory is not None else []
    with progress_bar("writing", "frame") as progress:
        estimated = {pose.t_ns: pose.T_world_camera for pose in poses}
        record_sequence(sequence, target, estimated, progress)


def _compressed(image: ColourImage, calibration: Calibration) -> ColourImage:
    if image.encoding is not ColourEncoding.RGB8:
        return image
    return encode_jpeg(decode_colour(image, calibration.colour.intrinsics))


def _calibration(camera: Camera, frame_id: str, t_ns: int) -> Any:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    size = camera.intrinsics
    K = size.matrix()
    return CameraCalibration(
        timestamp=_stamp(t_ns),
        frame_id=frame_id,
        width=size.width,
        height=size.height,
        distortion_model="kannala_brandt" if camera.fisheye else "plumb_bob",
        D=camera.distortion or (0.0,) * 5,
        K=K.ravel(),
        R=np.eye(3).ravel(),
        P=np.hstack([K, np.zeros((3, 1))]).ravel(),
    )


def _transform(frames: tuple[str, str], T: Matrix, t_ns: int) -> Any:
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

    pose = Pose.from_matrix(T)
    return FrameTransform(
        timestamp=_stamp(t_ns),
        parent_frame_id=frames[0],
        child_frame_id=frames[1],
        translation=Vector3(**vars(pose.position)),
        rotation=Quaternion(**vars(pose.orientation)),
    )


def _pose(T: Matrix, t_ns: int) -> Any:
    from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

    pose = Pose.from_matrix(T)
    position, rotation = Vector3(**vars(pose.position)), Quaternion(**vars(pose.orientation))
    told = PoseMessage(position=position, orientation=rotation)
    return PoseInFrame(timestamp=_stamp(t_ns), frame_id=_MAP, pose=told)


def _stamp(t_ns: int) -> Any:
    from google.protobuf.timestamp_pb2 import Timestamp

    return Timestamp(seconds=t_ns // _NS, nanos=t_ns % _NS)
