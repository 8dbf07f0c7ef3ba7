"""Poses in the axes of others: OpenGL (and OpenXR), ROS. Ours are OpenCV's.

Both frames of a pose are renamed alike, the camera's and the map's: the motion is the same, and a
map that starts at the first camera does so in every convention.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray


class Axes(StrEnum):
    """Which way x, y and z point, seen from behind the camera."""

    OPENCV = "opencv"  # right, down, forward
    OPENGL = "opengl"  # right, up, backward
    ROS = "ros"  # forward, left, up (REP 103)


# Rows are the new axes in ours.
_R_AXES_OPENCV = {
    Axes.OPENCV: np.eye(3),
    Axes.OPENGL: np.diag([1.0, -1.0, -1.0]),
    Axes.ROS: np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}


def in_axes(T_map_camera: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
    """A transform of ours in other axes, [4, 4]."""
    R = _R_AXES_OPENCV[axes]
    T = np.eye(4)
    T[:3, :3] = R @ T_map_camera[:3, :3] @ R.T
    T[:3, 3] = R @ T_map_camera[:3, 3]
    return T


def camera_in_axes(R_enu_camera: NDArray[np.float64], axes: Axes) -> NDArray[np.float64]:
    """A rotation from the camera's axes, from other axes of the same camera, [3, 3]."""
    return R_enu_camera @ _R_AXES_OPENCV[axes].T
