"""Compile, or load from the cache, every kernel before a service says that it is ready."""

from __future__ import annotations

import numpy as np
import torch

from services.mapping import rasterizer
from services.mapping.config import MappingConfig
from services.mapping.keyframes import warm_up as keyframes
from services.mapping.losses import ssim
from services.mapping.pipeline import Mapper, NewKeyframe
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import DepthEncoding, Frame
from shared.images import encode_depth, encode_jpeg
from shared.maps import RenderRequest
from shared.tracks import KeyframePoses


def warm_up() -> None:
    """One thread for torch, our own pools use the rest; then one iteration on a tiny keyframe."""
    torch.set_num_threads(1)
    rasterizer.warm_up()
    ssim.warm_up()
    keyframes.warm_up()
    size = Intrinsics(32.0, 32.0, 15.5, 15.5, 32, 32)
    grey = np.full((32, 32, 3), 128, np.uint8)
    depth = np.full((32, 32), 1000, np.uint16)
    depth[8:16, 8:16] = 0  # a hole to be filled
    frame = Frame(0, 0, encode_jpeg(grey), encode_depth(depth, DepthEncoding.RAW16))
    poses = KeyframePoses(1, np.zeros(1, np.int64), np.eye(4)[None])
    calibration = Calibration(Camera(size), depth_scale=1000.0)
    mapper = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))
    mapper.insert_keyframe(NewKeyframe(frame, poses, np.zeros((0, 3))))
    mapper.iterate()
    mapper.refine(0.0)
    mapper.render(RenderRequest(np.eye(4), size))
