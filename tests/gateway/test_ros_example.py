"""The functions of the ROS 2 example that need no ROS."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from shared.frames import TrackingStatus
from shared.se3 import Pose, exp
from shared.stream import FrameReply

FILE = Path(__file__).resolve().parents[2] / "examples" / "ros2" / "pointslam_node.py"


@pytest.fixture(scope="module")
def node():
    spec = importlib.util.spec_from_file_location("pointslam_node", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def message(**fields) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=12, nanosec=500)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="optical"), **fields)


def image(rows: np.ndarray, encoding: str) -> SimpleNamespace:
    size = {"height": rows.shape[0], "width": rows.shape[1], "step": rows[0].nbytes}
    return message(encoding=encoding, data=rows.tobytes(), **size)


def stamped(**fields) -> SimpleNamespace:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
    return SimpleNamespace(header=header, **fields)


def test_ros_images_are_tracked_by_a_gateway(node, client):
    depth = image(np.full((48, 64), 1500, np.uint16), "16UC1")
    colour = image(np.full((48, 64, 3), 99, np.uint8), "rgb8")
    info = message(
        **{"width": 64, "height": 48, "distortion_model": "plumb_bob", "d": [0.0] * 5},
        k=[60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0],
    )
    session = client.create_session(node.calibration_of(info, depth))

    (reply,) = session.stream([node.frame_of(session, colour, depth)])

    assert reply.status is TrackingStatus.TRACKED


def test_a_reply_becomes_a_pose_and_a_transform(node):
    T = exp([0.1, 0.2, 0.3, 0.0, 0.4, 0.0])
    reply = FrameReply(3, 12_000_000_500, TrackingStatus.TRACKED, Pose.from_matrix(T))
    pose = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    moved = SimpleNamespace(translation=SimpleNamespace(), rotation=SimpleNamespace())
    as_pose, as_transform = stamped(pose=pose), stamped(transform=moved)

    assert node.fill_pose(reply, as_pose, as_transform)

    expected = Pose.from_matrix(T)
    assert vars(pose.position) == pytest.approx(vars(expected.position))
    assert vars(moved.rotation) == pytest.approx(vars(expected.orientation))
    assert (as_pose.header.stamp.sec, as_pose.header.stamp.nanosec) == (12, 500)


def test_a_lost_frame_has_no_pose(node):
    reply = FrameReply(3, 0, TrackingStatus.LOST)

    assert not node.fill_pose(reply, stamped(), stamped())
