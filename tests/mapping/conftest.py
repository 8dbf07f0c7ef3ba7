"""A small textured room with exact poses, as keyframes and log entries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from shared import se3
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import DepthEncoding, Frame, TrackingStatus
from shared.images import encode_depth, encode_jpeg
from shared.tracks import (
    Advance,
    Correction,
    FrameRecord,
    KeyframeData,
    Observations,
    PointCloud,
    landmark_id,
)

CAMERA = Intrinsics(fx=80.0, fy=80.0, cx=47.5, cy=35.5, width=96, height=72)
LANDMARKS = 40


@pytest.fixture
def calibration() -> Calibration:
    return Calibration(Camera(CAMERA), depth_scale=1000.0)


def _rays() -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _pose(seq: int) -> np.ndarray:
    """A camera that slides along x and turns a little."""
    return se3.from_rotation(se3.exp([0, 0, 0, 0, 0.004 * seq, 0])[:3, :3], [0.02 * seq, 0.0, 0.0])


def _trace(seq: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] and colour [H, W, 3] of a wall at z = 2 with a floor at y = 0.8."""
    T = _pose(seq)
    rays = _rays() @ T[:3, :3].T
    origin = T[:3, 3]
    wall = (2.0 - origin[2]) / rays[..., 2]
    floor = np.where(rays[..., 1] > 1e-6, (0.8 - origin[1]) / rays[..., 1].clip(1e-6), np.inf)
    depth = np.minimum(wall, floor)  # rays have unit z in the camera, so this is depth
    x, y, z = np.moveaxis(origin + rays * depth[..., None], -1, 0)
    on_floor = floor < wall
    waves = [np.sin(5 * x + 3 * z), np.sin(4 * y + 2 * x), np.cos(6 * x - 4 * (y + z))]
    colour = 0.5 + 0.3 * np.stack(waves, axis=-1) - 0.1 * on_floor[..., None]
    return depth.astype(np.float32), (255 * colour.clip(0, 1)).round().astype(np.uint8)


@pytest.fixture
def true_pose() -> Callable[[int], np.ndarray]:
    return _pose


@pytest.fixture
def true_colour() -> Callable[[int], np.ndarray]:
    return lambda seq: _trace(seq)[1]


@pytest.fixture
def frame() -> Callable[[int], Frame]:
    def make(seq: int) -> Frame:
        depth, colour = _trace(seq)
        raw = (1000 * depth).round().astype(np.uint16)
        depth_image = encode_depth(raw, DepthEncoding.RAW16)
        return Frame(seq, seq * 33_000_000, encode_jpeg(colour, 98), depth_image)

    return make


def _keyframe_data(seq: int) -> KeyframeData:
    depth, _ = _trace(seq)
    rng = np.random.default_rng(seq)
    v = rng.integers(4, CAMERA.height - 4, LANDMARKS)
    u = rng.integers(4, CAMERA.width - 4, LANDMARKS)
    points = (_rays() * depth[..., None])[v, u]
    ids = landmark_id(seq, np.arange(LANDMARKS))
    cloud = (_rays() * depth[..., None])[::6, ::6].reshape(-1, 3).astype(np.float32)
    towards = -cloud / np.linalg.norm(cloud, axis=1, keepdims=True)
    return KeyframeData(
        observations=Observations(
            landmark_ids=ids,
            keypoints_px=np.stack([u, v], 1).astype(np.float32),
            octaves=np.zeros(LANDMARKS, np.uint8),
            depths_m=depth[v, u],
            descriptors=rng.integers(0, 256, (LANDMARKS, 32)).astype(np.uint8),
        ),
        landmark_normals_camera=np.tile(np.array([0, 0, -1], np.float32), (LANDMARKS, 1)),
        cloud_camera=PointCloud(cloud, towards),
        thumbnail=np.zeros((15, 20), np.uint8),
        correction=Correction(
            np.array([seq]), _pose(seq)[None], ids, se3.transform(_pose(seq), points)
        ),
    )


@pytest.fixture
def entry(frame: Callable[[int], Frame]) -> Callable[..., Advance]:
    """A log entry; every fourth frame is a keyframe unless said otherwise."""

    def make(seq: int, is_keyframe: bool | None = None) -> Advance:
        is_keyframe = seq % 4 == 0 if is_keyframe is None else is_keyframe
        reference = seq - seq % 4
        record = FrameRecord(
            seq=seq,
            t_ns=seq * 33_000_000,
            status=TrackingStatus.TRACKED,
            reference_seq=reference,
            T_reference_camera=se3.inverse(_pose(reference)) @ _pose(seq),
            T_world_camera=_pose(seq),
            covariance=np.eye(6),
        )
        if not is_keyframe:
            return Advance(record)
        return Advance(record, frame(seq), _keyframe_data(seq))

    return make
