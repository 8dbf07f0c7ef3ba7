"""A ROS 2 node: an RGB-D camera's topics to a PointSLAM++ gateway, poses back as topics and tf.

    ros2 run ... or: python pointslam_node.py --ros-args -p gateway:=http://127.0.0.1:8080 \
        -r colour:=/camera/color/image_raw -r depth:=/camera/aligned_depth_to_color/image_raw \
        -r camera_info:=/camera/color/camera_info

Publishes `pose` (geometry_msgs/PoseStamped in frame `map`) and the transform map -> camera frame.
ROS's optical frames have OpenCV's axes, as PointSLAM++ has, so poses pass as they are. Only
tracked frames are published: a lost camera has no pose.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from typing import Any

from pointslam.client import Client, Session
from pointslam.datasets.mcap_messages import camera_of, colour_image, depth_image, image_message
from shared.camera import Calibration
from shared.frames import HAS_POSE
from shared.stream import FrameMessage, FrameReply

_IMAGE, _CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_NS, _MILLIMETRES, _METRES = 1_000_000_000, 1000.0, 4000.0
_WAITING = 2  # frames; when the gateway is slower than the camera the oldest is dropped


def calibration_of(camera_info: Any, depth: Any) -> Calibration:
    """The device, of a CameraInfo and a depth Image that is aligned to colour."""
    scale = _METRES if depth.encoding == "32FC1" else _MILLIMETRES
    return Calibration(camera_of(_CAMERA_INFO, camera_info)[1], scale)


def frame_of(session: Session, colour: Any, depth: Any) -> FrameMessage:
    """The next frame of a session, of two Images; it has colour's stamp."""
    rgb, raw = image_message(_IMAGE, colour), image_message(_IMAGE, depth)
    return session.frame(colour_image(rgb), depth_image(raw), rgb.t_ns)


def fill_pose(reply: FrameReply, stamped: Any, transform: Any) -> bool:
    """Fill a PoseStamped and a TransformStamped in place; False where the reply has no pose."""
    if reply.status not in HAS_POSE or reply.T_map_camera is None:
        return False
    for message in (stamped, transform):
        message.header.frame_id = "map"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(reply.t_ns, _NS)
    position, orientation = reply.T_map_camera.position, reply.T_map_camera.orientation
    for axis in "xyz":
        setattr(stamped.pose.position, axis, getattr(position, axis))
        setattr(transform.transform.translation, axis, getattr(position, axis))
    for axis in "xyzw":
        setattr(stamped.pose.orientation, axis, getattr(orientation, axis))
        setattr(transform.transform.rotation, axis, getattr(orientation, axis))
    return True


def main() -> None:
    """Run the node until ROS ends."""
    import message_filters
    import rclpy
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from rclpy.node import Node
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_ros import TransformBroadcaster

    rclpy.init()
    node = Node("pointslam")
    gateway = node.declare_parameter("gateway", "http://127.0.0.1:8080").value
    name = node.declare_parameter("session", "").value or None
    poses, transforms = node.create_publisher(PoseStamped, "pose", 10), TransformBroadcaster(node)
    waiting: queue.Queue[tuple[Any, Any, Any]] = queue.Queue(_WAITING)

    def take(colour: Any, depth: Any, info: Any) -> None:
        if waiting.full():
            waiting.get_nowait()
        waiting.put_nowait((colour, depth, info))

    topics = {"colour": Image, "depth": Image, "camera_info": CameraInfo}
    subscribers = [message_filters.Subscriber(node, kind, t) for t, kind in topics.items()]
    message_filters.ApproximateTimeSynchronizer(subscribers, 10, 0.02).registerCallback(take)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()

    with Client(gateway) as client:
        colour, depth, info = waiting.get()
        session = client.create_session(calibration_of(info, depth), name=name)

        def frames() -> Iterator[FrameMessage]:
            while rclpy.ok():
                colour, depth, _ = waiting.get()
                yield frame_of(session, colour, depth)

        for reply in session.stream(frames()):
            stamped, transform = PoseStamped(), TransformStamped()
            transform.child_frame_id = colour.header.frame_id
            if fill_pose(reply, stamped, transform):
                poses.publish(stamped)
                transforms.sendTransform(transform)


if __name__ == "__main__":
    main()
