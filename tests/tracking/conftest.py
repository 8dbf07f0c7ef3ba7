"""A textured box room with exact depth and poses, and a map in this process to track it in."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from services.gateway.prior import next_prior
from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.executors import NoHelper
from services.tracking.local_map import LocalMap, derive
from services.tracking.pipeline import track
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
from shared.rectify import RgbdImage
from shared.tracks import Candidates, CandidatesRequest, TrackResult

CAMERA = Intrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)
CALIBRATION = Calibration(Camera(CAMERA), depth_scale=5000.0)
HALF_SIDES_M = np.array([1.6, 1.2, 2.1])


@dataclass(frozen=True)
class Room:
    """An axis-aligned box seen from inside; walls carry random cells of 9 cm and of 4 cm."""

    intrinsics: Intrinsics = CAMERA
    calibration: Calibration = CALIBRATION

    def view(self, T_world_camera: NDArray[np.float64]) -> RgbdImage:
        """Colour and depth from a pose inside the room."""
        i = self.intrinsics
        u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
        rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1)
        rays = rays @ T_world_camera[:3, :3].T
        origin = T_world_camera[:3, 3]
        with np.errstate(divide="ignore"):
            hits = (np.sign(rays) * HALF_SIDES_M - origin) / rays
        depth = np.min(np.where(hits > 0.0, hits, np.inf), axis=-1)
        points = rays * depth[..., None] + origin
        shade = (_cells(points, 0.09) // 2 + _cells(points, 0.04) // 2).astype(np.uint8)
        return RgbdImage(
            np.repeat(shade[..., None], 3, axis=-1), depth.astype(np.float32), self.intrinsics
        )

    def frame(self, seq: int, T_world_camera: NDArray[np.float64]) -> Frame:
        """The view as a client would send it; depth is rounded to a fifth of a millimetre."""
        image = self.view(T_world_camera)
        depth_raw = np.round(image.depth_m * self.calibration.depth_scale).astype("<u2")
        return Frame(
            seq=seq,
            t_ns=seq * 33_000_000,
            rgb=ColourImage(ColourEncoding.RGB8, image.rgb.tobytes()),
            depth=DepthImage(DepthEncoding.RAW16, depth_raw.tobytes()),
        )


def _cells(points: NDArray[np.float64], size_m: float) -> NDArray[np.int64]:
    cells = np.floor(points / size_m + 0.3).astype(np.int64)
    return (cells @ np.array([7919, 104729, 1299709])) * 2654435761 >> 7 & 0xFF


class StoreSource:
    """A keyframe store as tracking asks for it; every answer is built anew."""

    def __init__(self, store: KeyframeStore, config: TrackingConfig) -> None:
        self._store = store
        self._config = config

    def local_map(self, reference_seq: int) -> LocalMap:
        return derive(self._store.context(reference_seq), self._config.registration)

    def loop_map(self, seq: int) -> LocalMap:
        return derive(self._store.loop_context(seq), self._config.registration)

    def candidates(self, request: CandidatesRequest) -> Candidates:
        return self._store.candidates(request)


@dataclass
class Session:
    """Tracks frame after frame as the gateway and the map's owner would let it happen."""

    config: TrackingConfig = field(default_factory=TrackingConfig)
    calibration: Calibration = CALIBRATION
    prior: Prior | None = None
    store: KeyframeStore = field(default_factory=KeyframeStore)

    def request(self, frame: Frame) -> TrackRequest:
        return TrackRequest(
            session="test",
            epoch=1,
            map_revision=self.store.revision,
            calibration=self.calibration,
            frame=frame,
            prior=self.prior,
            T_world_first=np.eye(4),
        )

    def answer(self, frame: Frame, helper: Executor | None = None) -> TrackResult:
        """The result for a frame, without taking note of it."""
        source = StoreSource(self.store, self.config)
        return track(self.request(frame), source, self.config, helper or NoHelper())

    def track(self, frame: Frame) -> TrackResult:
        result = self.answer(frame)
        if result.keyframe is not None:
            self.store.insert(result.seq, result.t_ns, result.T_world_camera, result.keyframe)
        self.prior = next_prior(self.prior, frame, result)
        return result


@pytest.fixture(scope="session")
def room() -> Room:
    return Room()


@pytest.fixture
def session() -> Session:
    return Session()


@pytest.fixture(scope="session")
def new_session() -> type[Session]:
    """What makes a session of its own."""
    return Session


@pytest.fixture(scope="session")
def source_of() -> type[StoreSource]:
    """What makes a source of a keyframe store."""
    return StoreSource
