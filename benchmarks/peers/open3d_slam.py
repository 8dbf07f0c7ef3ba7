"""Open3D's dense SLAM: every frame registered to the ray-cast voxel model, then integrated."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from benchmarks.peers.base import MAX_DEPTH_M, PeerPose
from benchmarks.peers.open3d_tensors import image, tensor
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

_VOXEL_M = 0.01
_BLOCK_VOXELS = 16
_NUM_BLOCKS = 20000
_TRUNCATION_VOXELS = 8.0
_MIN_DEPTH_M = 0.1
_MAX_DEPTH_STEP_M = 0.07


class Open3dSlam:
    """A voxel block grid of signed distances and its view from the last pose."""

    def __init__(self) -> None:
        device = o3d.core.Device("CPU:0")
        # Its notes go to the standard output, where our table or JSON is.
        o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
        T_world_camera = tensor(np.eye(4))
        self._model = o3d.t.pipelines.slam.Model(
            _VOXEL_M, _BLOCK_VOXELS, _NUM_BLOCKS, T_world_camera, device
        )
        self._T_world_camera = np.eye(4)
        self._cast: o3d.t.pipelines.slam.Frame | None = None
        self._count = 0

    def track(self, frame: RgbdImage) -> PeerPose:
        """Register to the model as cast from the last pose, integrate, cast again."""
        now = _frame(frame.intrinsics)
        now.set_data_from_image("depth", image(frame.depth_m[..., None]))
        now.set_data_from_image("color", image(frame.rgb.astype(np.float32) / 255.0))
        is_tracked = True
        if self._cast is None:
            self._cast = _frame(frame.intrinsics)
        else:
            is_tracked = self._register(now, self._cast)
        self._model.update_frame_pose(self._count, tensor(self._T_world_camera))
        self._model.integrate(now, 1.0, MAX_DEPTH_M, _TRUNCATION_VOXELS)
        self._model.synthesize_model_frame(
            self._cast, 1.0, _MIN_DEPTH_M, MAX_DEPTH_M, _TRUNCATION_VOXELS, False
        )
        self._count += 1
        return PeerPose(self._T_world_camera, is_tracked)

    def _register(
        self, frame: o3d.t.pipelines.slam.Frame, cast: o3d.t.pipelines.slam.Frame
    ) -> bool:
        try:
            result = self._model.track_frame_to_model(
                frame, cast, 1.0, MAX_DEPTH_M, _MAX_DEPTH_STEP_M
            )
        except RuntimeError:  # a singular system: it found no motion
            return False
        self._T_world_camera = self._T_world_camera @ result.transformation.numpy()
        return True


def _frame(intrinsics: Intrinsics) -> o3d.t.pipelines.slam.Frame:
    matrix = tensor(intrinsics.matrix())
    device = o3d.core.Device("CPU:0")
    return o3d.t.pipelines.slam.Frame(intrinsics.height, intrinsics.width, matrix, device)
