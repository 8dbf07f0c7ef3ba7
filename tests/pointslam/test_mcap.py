"""MCAP: what we write is replayed, and what ROS 2 writes is read."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.writer import Writer as RosWriter

from pointslam.datasets import FileSequence, SequenceOptions, open_sequence
from pointslam.recording import Recorder, record_sequence
from shared import se3
from shared.errors import SequenceError
from shared.images import decode_colour, decode_depth

HEADER = """std_msgs/Header header
"""
STD = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
IMAGE = f"""{HEADER}uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data{STD}"""
INFO = f"""{HEADER}uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p{STD}"""
WIDTH, HEIGHT, PADDING = 64, 48, 5


@pytest.fixture(scope="module")
def recorded(room, tmp_path_factory) -> FileSequence:
    """The room as our own MCAP file, read again."""
    path = tmp_path_factory.mktemp("mcap") / "room.mcap"
    record_sequence(room, path, {}, lambda done, total: None)
    return open_sequence(path)


def test_a_recording_has_every_frame_with_its_time_and_truth(room, recorded):
    assert [recorded.t_ns(i) for i in range(len(recorded))] == [
        room.t_ns(i) for i in range(len(room))
    ]
    np.testing.assert_allclose(recorded.truth(7), room.truth(7), atol=1e-12)


def test_a_recording_has_the_images_untouched(room, recorded):
    expected, found = room.frame(5), recorded.frame(5)

    assert found.rgb == expected.rgb
    np.testing.assert_array_equal(
        decode_depth(found.depth, recorded.calibration),
        decode_depth(expected.depth, room.calibration),
    )


def test_a_recording_has_the_calibration(room, recorded):
    assert recorded.calibration.colour == room.calibration.colour
    assert recorded.calibration.depth_scale == room.calibration.depth_scale
    assert recorded.calibration.depth is None


def test_foxglove_finds_its_own_schemas_in_a_recording(recorded):
    with recorded.path.open("rb") as file:
        summary = make_reader(file).get_summary()

    assert summary is not None
    assert {schema.name for schema in summary.schemas.values()} == {
        "foxglove.CameraCalibration",
        "foxglove.CompressedImage",
        "foxglove.FrameTransform",
        "foxglove.PoseInFrame",
        "foxglove.RawImage",
    }


def test_depth_with_a_place_of_its_own_keeps_it(room, tmp_path):
    T_colour_depth = se3.exp([0.025, 0.001, 0.0, 0.0, 0.01, 0.0])
    camera = replace(room.calibration.colour, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    apart = replace(room.calibration, depth=camera, T_colour_depth=T_colour_depth)
    path = tmp_path / "apart.mcap"

    with Recorder(path, apart) as recorder:
        recorder.frame(room.frame(0))

    found = open_sequence(path).calibration
    assert found.depth == camera
    np.testing.assert_allclose(found.T_colour_depth, T_colour_depth, atol=1e-12)


def pixels(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def header(number: int, frame_id: str) -> dict:
    return {"stamp": {"sec": 10, "nanosec": number * 33_000_000}, "frame_id": frame_id}


def image(number: int, frame_id: str, encoding: str, rows: np.ndarray) -> dict:
    """An image message whose rows are padded, as some drivers do."""
    packed = np.ascontiguousarray(rows).view(np.uint8).reshape(HEIGHT, -1)
    padded = np.pad(packed, ((0, 0), (0, PADDING * rows.itemsize)))
    return {
        "header": header(number, frame_id),
        **{"height": HEIGHT, "width": WIDTH, "encoding": encoding, "is_bigendian": 0},
        **{"step": padded.shape[1], "data": padded.tobytes()},
    }


@pytest.fixture
def ros_bag(tmp_path):
    """Writes a bag of three frames as a RealSense driver would."""

    def write(depth_frame: str = "optical", encoding: str = "16UC1", name: str = "depth"):
        path = tmp_path / "bag.mcap"
        K = [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]
        with path.open("wb") as file:
            writer = RosWriter(file)
            of = {
                "image": writer.register_msgdef("sensor_msgs/msg/Image", IMAGE),
                "info": writer.register_msgdef("sensor_msgs/msg/CameraInfo", INFO),
            }
            for number in range(3):
                at = 1_000_000 * number
                info = {
                    "header": header(number, "optical"),
                    **{"height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob"},
                    **{"d": [0.1, 0, 0, 0, 0], "k": K, "r": [0.0] * 9, "p": [0.0] * 12},
                }
                writer.write_message("/camera/color/camera_info", of["info"], info, at)
                colour = image(number, "optical", "bgr8", pixels(number))
                writer.write_message("/camera/color/image_raw", of["image"], colour, at)
                kind = np.float32 if encoding == "32FC1" else np.uint16
                rows = np.full((HEIGHT, WIDTH), 1.5 if kind is np.float32 else 1500, kind)
                depth = image(number, depth_frame, encoding, rows)
                writer.write_message(f"/camera/{name}/image_raw", of["image"], depth, at)
            writer.finish()
        return path

    return write


def test_a_bag_of_ros_2_is_a_sequence(ros_bag):
    sequence = open_sequence(ros_bag())

    assert len(sequence) == 3
    assert sequence.t_ns(1) == 10_033_000_000
    assert sequence.calibration.colour.distortion == (0.1, 0.0, 0.0, 0.0, 0.0)


def test_padded_rows_of_bgr_become_rgb(ros_bag):
    sequence = open_sequence(ros_bag())

    found = decode_colour(sequence.frame(2).rgb, sequence.calibration.colour.intrinsics)

    np.testing.assert_array_equal(found, cv2.cvtColor(pixels(2), cv2.COLOR_BGR2RGB))


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_millimetres_and_metres_are_both_depth(ros_bag, encoding):
    sequence = open_sequence(ros_bag(encoding=encoding))

    depth_m = decode_depth(sequence.frame(0).depth, sequence.calibration)

    np.testing.assert_allclose(depth_m, 1.5, atol=1e-6)


def test_depth_of_a_frame_of_its_own_is_refused(ros_bag):
    with pytest.raises(SequenceError, match="'ir', colour in 'optical', and nothing joins them"):
        open_sequence(ros_bag(depth_frame="ir"))


def test_a_topic_that_is_not_there_is_refused_with_those_that_are(ros_bag):
    options = SequenceOptions(depth_topic="/depth")

    with pytest.raises(SequenceError, match="/camera/depth/image_raw; /depth is none of them"):
        open_sequence(ros_bag(), options)


def test_a_torn_file_is_refused(recorded, tmp_path):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recorded.path.read_bytes()[:100_000])

    with pytest.raises(SequenceError, match="no whole MCAP file"):
        open_sequence(torn)
