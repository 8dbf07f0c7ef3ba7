"""What one frame shows: its surface on the caller's thread, its features on a helper's meanwhile.

Decoding colour and finding features needs no depth, registering needs nothing else, so the two run
side by side and meet where features are first asked for; whoever waits there finds a share of them.
Where there is no helper all runs one after the other, with the same result to the bit.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from services.tracking.config import TrackingConfig
from services.tracking.detection import Detected, Detection, detect
from services.tracking.executors import NoHelper, Once
from services.tracking.orb import Features, no_features, with_depth
from services.tracking.point_cloud import surface_from_depth
from services.tracking.stopwatch import Stopwatch
from services.tracking.surfaces import Surfaces, surfaces_of
from shared.camera import Calibration, Intrinsics
from shared.frames import ColourImage, DepthImage
from shared.rectify import RgbdImage, rectify_colour, rectify_depth
from shared.tracks import PointCloud


@dataclass(frozen=True)
class EncodedImages:
    """What a device sent; without depth there is no surface, and no feature has depth."""

    rgb: ColourImage
    depth: DepthImage | None
    calibration: Calibration


@dataclass(frozen=True)
class Appearance:
    """What the colour image shows."""

    rgb: NDArray[np.uint8]  # [H, W, 3]
    features: Features  # with depth where it can be trusted


@dataclass(frozen=True)
class Observed:
    """What one frame shows."""

    depth_m: NDArray[np.float32]  # [H, W], registered, 0 where there is none
    intrinsics: Intrinsics  # of both images
    cloud: PointCloud  # camera frame
    appearance: Future[Appearance]
    finest: Once[Detected]  # keypoints of the finest octave, for whoever has to wait
    surfaces: Once[Surfaces]
    config: TrackingConfig
    moving: Features = field(default_factory=no_features)  # of what moves, left out above
    is_moving: NDArray[np.bool_] | None = None  # [H, W], its pixels; None: nothing moves

    @cached_property
    def image(self) -> RgbdImage:
        """Colour and depth.

        Raises:
            InputError: the colour image cannot be decoded.
        """
        return RgbdImage(self.appearance.result().rgb, self.depth_m, self.intrinsics)

    @property
    def features(self) -> Features:
        """Features, with depth where it can be trusted; waits until they are found.

        Raises:
            InputError: the colour image cannot be decoded.
        """
        return self.appearance.result().features

    def without(self, moving: NDArray[np.bool_]) -> Observed:
        """The frame as if nothing were to be seen at some pixels, [H, W]; waits for features.

        Features are looked for again: a body with a bold pattern takes them all to itself.

        Raises:
            InputError: the colour image cannot be decoded.
        """
        i, points = self.intrinsics, self.cloud.points
        pixels = np.floor(points[:, :2] / points[:, 2:] * [i.fx, i.fy] + [i.cx + 0.5, i.cy + 0.5])
        u, v = pixels.astype(np.int64).clip(0, [i.width - 1, i.height - 1]).T
        stays = ~moving[v, u]
        is_moving = moving if self.is_moving is None else moving | self.is_moving
        pixels = np.rint(self.features.keypoints_px).astype(np.int64)
        u, v = pixels.clip(0, [i.width - 1, i.height - 1]).T
        on_it = np.flatnonzero(moving[v, u] & (self.features.depths_m > 0.0))
        rgb, orb = self.appearance.result().rgb, self.config.orb
        depth_m = np.where(moving, np.float32(0.0), self.depth_m)
        found = Appearance(rgb, with_depth(detect(rgb, orb, ~is_moving), depth_m, orb))
        return Observed(
            depth_m=depth_m,
            intrinsics=i,
            cloud=PointCloud(points[stays], self.cloud.normals[stays]),
            appearance=NoHelper().submit(lambda: found),
            finest=self.finest,
            surfaces=_surfaces(depth_m, self.config),
            config=self.config,
            moving=self.moving.joined(self.features.rows(on_it)),
            is_moving=is_moving,
        )

    def find_finest(self) -> None:
        """Find the keypoints of the finest octave here, unless they are by now.

        Raises:
            InputError: the colour image cannot be decoded.
        """
        self.finest.result()

    def wait(self) -> None:
        """Until the features are found.

        Raises:
            InputError: the colour image cannot be decoded.
        """
        self.find_finest()
        self.appearance.result()


def observe(
    images: EncodedImages, config: TrackingConfig, clock: Stopwatch, helper: Executor
) -> Observed:
    """Decode images and find their surface, while the helper finds their features.

    Raises:
        InputError: the depth image cannot be decoded.
    """

    def decode() -> tuple[NDArray[np.uint8], Detection]:
        with clock.stage("decode_colour"):
            rgb = rectify_colour(images.rgb, images.calibration)
            return rgb, Detection(rgb, config.orb)

    def decode_depth() -> NDArray[np.float32]:
        with clock.stage("decode_depth"):
            return _depth(images)

    def look() -> Appearance:
        rgb, detection = colour.result()
        with clock.stage("orb"):
            keypoints = detection.keypoints()
        return Appearance(rgb, with_depth(keypoints, depth.result(), config.orb))

    colour, depth = Once(decode), Once(decode_depth)
    finest = Once(lambda: colour.result()[1].finest.result())
    appearance = helper.submit(look)
    depth_m, intrinsics = depth.result(), images.calibration.colour.intrinsics
    with clock.stage("points"):
        cloud = surface_from_depth(depth_m, intrinsics, config.surface)
    surfaces = _surfaces(depth_m, config)
    helper.submit(surfaces.result)
    return Observed(depth_m, intrinsics, cloud, appearance, finest, surfaces, config)


def _surfaces(depth_m: NDArray[np.float32], config: TrackingConfig) -> Once[Surfaces]:
    return Once(lambda: surfaces_of(depth_m, config.moving.grid_px, config.moving.max_jump))


def _depth(images: EncodedImages) -> NDArray[np.float32]:
    if images.depth is not None:
        return rectify_depth(images.depth, images.calibration)
    size = images.calibration.colour.intrinsics
    return np.zeros((size.height, size.width), np.float32)
