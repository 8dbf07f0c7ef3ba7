"""The client library: frames in, poses and views out, synchronous and asynchronous.

with Client("http://127.0.0.1:8080") as client:
    session = client.create_session(calibration)
    reply = session.track(rgb, depth, t_ns)
    view = session.render(T_world_camera)
"""

from pointslam.client.async_session import AsyncSession
from pointslam.client.asynchronous import AsyncClient
from pointslam.client.messages import FrameOptions, frame_message
from pointslam.client.session import Session
from pointslam.client.synchronous import Client

__all__ = ["AsyncClient", "AsyncSession", "Client", "FrameOptions", "Session", "frame_message"]
