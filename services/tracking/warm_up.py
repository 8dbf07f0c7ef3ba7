"""Compile every kernel before the first frame comes: a box room, tracked through every stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TrackingConfig
from services.tracking.local_map import LocalMap, derive
from services.tracking.pipeline import track
from shared import codec
from shared.camera import Calibration, Camera, Intrinsics
from shared.frames import (
    ColourEncoding,
    ColourImage,
    DepthEncoding,
    DepthImage,
    Frame,
    Prior,
    TrackRequest,
)
from shared.rectify import register_depth
from shared.se3 import exp
from shared.tracks import (
    Candidate,
    Candidates,
    CandidatesRequest,
    KeyframeData,
    Landmarks,
    PointCloud,
    TrackingContext,
    TrackResult,
    WindowKeyframe,
)

_CAMERA = Intrinsics(200.0, 200.0, 159.5, 119.5, 320, 240)
_ROOM_M = np.array([1.5, 1.2, 2.0])  # half its sides; the camera starts at the centre


def warm_up(config: TrackingConfig) -> None:
    """Track a few frames of a made-up room; afterwards nothing is compiled any more.

    Messages go through the codec as real ones do: kernels are compiled for their read-only arrays.
    """
    first = track(_request(0, 0.0, None), _OneKeyframe(None, config), config)
    assert first.keyframe is not None
    source = _OneKeyframe(first, config)
    near = track(_request(10, 0.05, _prior(0.04)), source, config)
    assert near.keyframe is not None
    track(_request(11, 0.1, None), source, config)
    after_a_step = replace(_prior(0.04), T_before_last=exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    track(_request(12, 0.1, after_a_step), source, config)
    register_depth(np.ones((120, 160), np.float32), _CAMERA, _CAMERA, np.eye(4))


class _OneKeyframe:
    """A map that holds the first frame as a keyframe, or nothing yet."""

    def __init__(self, first: TrackResult | None, config: TrackingConfig) -> None:
        keyframe = first.keyframe if first else None
        context = _context(keyframe) if keyframe else _empty_context()
        context = codec.unpack(TrackingContext, codec.pack(context))
        self._local = derive(context, config.registration)

    def local_map(self, reference_seq: int) -> LocalMap:
        """The only one."""
        return self._local

    def loop_map(self, seq: int) -> LocalMap:
        """The only one."""
        return self._local

    def candidates(self, request: CandidatesRequest) -> Candidates:
        """The only keyframe."""
        return Candidates(0, (Candidate(0, np.eye(4), self._local.context.landmarks),))


def _request(seq: int, x_m: float, prior: Prior | None) -> TrackRequest:
    rgb, depth_raw = _view_of_room(x_m)
    frame = Frame(
        seq=seq,
        t_ns=seq * 33_000_000,
        rgb=ColourImage(ColourEncoding.RGB8, rgb.tobytes()),
        depth=DepthImage(DepthEncoding.RAW16, depth_raw.tobytes()),
    )
    calibration = Calibration(Camera(_CAMERA), 1000.0)
    request = TrackRequest("warm-up", 0, 0, calibration, frame, prior, np.eye(4))
    return codec.unpack(TrackRequest, codec.pack(request))


def _view_of_room(x_m: float) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Colour and depth (mm) of a textured box from a camera x_m right of its centre."""
    i = _CAMERA
    u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones_like(u)], axis=-1)
    with np.errstate(divide="ignore"):
        hits = (np.sign(rays) * _ROOM_M - [x_m, 0.0, 0.0]) / rays
    depth = np.min(np.where(hits > 0.0, hits, np.inf), axis=-1)
    points = rays * depth[..., None] + [x_m, 0.0, 0.0]
    cells = np.floor(points / 0.08 + 0.5).astype(np.int64)
    shade = (cells @ np.array([7919, 104729, 1299709])) * 2654435761 >> 7 & 0xFF
    rgb = np.repeat(shade.astype(np.uint8)[..., None], 3, axis=-1)
    depth[: i.height // 4] = 0.0  # features there need a second view
    return np.ascontiguousarray(rgb), (1000.0 * depth).astype("<u2")


def _prior(x_m: float) -> Prior:
    T = np.eye(4)
    T[0, 3] = x_m
    return Prior(
        seq=9,
        t_ns=9 * 33_000_000,
        T_world_camera=T,
        T_before_last=np.eye(4),
        before_last_dt_ns=33_000_000,
        reference_seq=0,
        newest_keyframe_seq=0,
        lost_frames=0,
        frames_since_keyframe=100,
    )


def _context(keyframe: KeyframeData) -> TrackingContext:
    """The map after its first keyframe, at the origin."""
    observations, correction = keyframe.observations, keyframe.correction
    rows = np.flatnonzero(observations.depths_m > 0.0)
    landmarks = Landmarks(
        ids=correction.landmark_ids,
        positions_world=correction.positions_world,
        normals_world=keyframe.landmark_normals_camera[rows],
        descriptors=observations.descriptors[rows],
        octaves=observations.octaves[rows],
        distances_m=np.linalg.norm(correction.positions_world, axis=1).astype(np.float32),
    )
    window = (WindowKeyframe(0, np.eye(4), True, observations),)
    return TrackingContext(0, 0, np.eye(4), keyframe.cloud_camera, landmarks, window, 1)


def _empty_context() -> TrackingContext:
    none = np.zeros((0, 3), np.float32)
    landmarks = Landmarks(
        ids=np.zeros(0, np.int64),
        positions_world=np.zeros((0, 3)),
        normals_world=none,
        descriptors=np.zeros((0, 32), np.uint8),
        octaves=np.zeros(0, np.uint8),
        distances_m=np.zeros(0, np.float32),
    )
    return TrackingContext(0, -1, np.eye(4), PointCloud(none, none), landmarks, (), 0)
