"""When a frame becomes a keyframe, and what it then brings to the map."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from services.tracking.config import KeyframeRuleConfig, TrackingConfig
from services.tracking.orb import Features
from services.tracking.point_cloud import BASE_PIXELS, normals_at
from services.tracking.sharpness import edge_blur_px
from shared.camera import Intrinsics
from shared.frames import Frame, Prior
from shared.rectify import RgbdImage
from shared.se3 import angle_rad, inverse
from shared.tracks import (
    MOVING,
    NO_LANDMARK,
    Correction,
    KeyframeData,
    Observations,
    PointCloud,
    WindowKeyframe,
    landmark_id,
)


@dataclass(frozen=True)
class Coverage:
    """How well the map around already shows what a frame sees."""

    num_points: int  # of the frame's surface
    overlap: float  # share of the frame's surface that the map has
    landmarks: int  # that its features agree with
    landmark_share: float  # share of its features with depth that are landmarks
    T_reference_camera: NDArray[np.float64]  # [4, 4]
    median_depth_m: float
    step_deg: float  # turned since the last frame with a pose
    waiting: int = 0  # features of no landmark where no depth is measured

    @property
    def turn_deg(self) -> float:
        """Turned since the reference keyframe."""
        return float(np.degrees(angle_rad(self.T_reference_camera)))


@dataclass(frozen=True)
class Sharpness:
    """Blur of an image's edges beside that of the keyframes around, in pixels."""

    edge_blur_px: float
    usual_blur_px: float

    @property
    def added_blur_px(self) -> float:
        """What motion has added: blurs add as variances do."""
        return float(np.sqrt(max(self.edge_blur_px**2 - self.usual_blur_px**2, 0.0)))


def sharpness_of(edge_blur_px: float, window: tuple[WindowKeyframe, ...]) -> Sharpness:
    """A frame's sharpness; keyframes whose blur nobody knows are left out."""
    known = [keyframe.edge_blur_px for keyframe in window if keyframe.edge_blur_px > 0.0]
    return Sharpness(edge_blur_px, float(np.median(known)) if known else edge_blur_px)


def is_too_blurred(
    sharpness: Sharpness, coverage: Coverage, intrinsics: Intrinsics, config: KeyframeRuleConfig
) -> bool:
    """Far less sharp than the keyframes around, while these show enough for one more such step."""
    scale = np.sqrt(intrinsics.width * intrinsics.height / BASE_PIXELS)
    is_blurred = sharpness.added_blur_px > config.max_added_blur_px * scale
    can_wait = (
        coverage.overlap >= config.min_blurred_overlap
        and coverage.landmarks >= config.min_blurred_landmarks
        and coverage.turn_deg + coverage.step_deg <= config.max_blurred_turn_deg
    )
    return bool(is_blurred and can_wait)


def becomes_keyframe(
    frame: Frame, prior: Prior, coverage: Coverage, config: KeyframeRuleConfig
) -> bool:
    """GS-ICP's overlap and interval rules and ORB-SLAM's feature rule.

    Never a repeated view, and without a surface only one that enough landmarks hold.
    """
    step_m = float(np.linalg.norm(coverage.T_reference_camera[:3, 3]))
    moved = step_m > config.min_step_m or coverage.turn_deg > config.min_turn_deg
    is_repeat = prior.frame_digest == frame.digest()
    if is_repeat or not (frame.may_be_keyframe and moved):
        return False
    has_surface = coverage.num_points >= config.min_points
    if not has_surface and coverage.landmarks < config.min_landmarks:
        return False
    return (
        (has_surface and coverage.overlap < config.min_overlap)
        or coverage.landmark_share < config.min_landmark_share
        or coverage.landmarks < min(config.few_landmarks, coverage.waiting)
        or prior.frames_since_keyframe + 1 >= config.max_interval
        or coverage.turn_deg > config.max_turn_deg
        or step_m > config.max_step_share * coverage.median_depth_m
    )


def keyframe_observations(
    seq: int, features: Features, landmark_ids: NDArray[np.int64]
) -> Observations:
    """All features of a keyframe; those of no landmark yet found a new one.

    Those without depth wait for another keyframe to place it.

    Args:
        seq: of the keyframe.
        features: all of the frame.
        landmark_ids: of the matched ones, NO_LANDMARK elsewhere, [M].
    """
    founds = (landmark_ids == NO_LANDMARK) & ((features.depths_m > 0.0) | features.is_unmeasured)
    own = landmark_id(seq, np.arange(len(landmark_ids), dtype=np.int64))
    return Observations(
        landmark_ids=np.where(founds, own, landmark_ids),
        keypoints_px=features.keypoints_px,
        octaves=features.octaves,
        depths_m=features.depths_m,
        descriptors=features.descriptors,
    )


def with_moving(observations: Observations, moving: Features) -> Observations:
    """A keyframe's observations and, after them, the features of what moves."""
    ids = np.full(len(moving.octaves), MOVING, np.int64)
    seen = observations
    return Observations(
        landmark_ids=np.concatenate([seen.landmark_ids, ids]),
        keypoints_px=np.concatenate([seen.keypoints_px, moving.keypoints_px]),
        octaves=np.concatenate([seen.octaves, moving.octaves]),
        depths_m=np.concatenate([seen.depths_m, moving.depths_m]),
        descriptors=np.concatenate([seen.descriptors, moving.descriptors]),
    )


@dataclass(frozen=True)
class KeyframeLooks:
    """What a keyframe shows, wherever its window places it."""

    landmark_normals_camera: NDArray[np.float32]  # [M, 3], at its features
    cloud_camera: PointCloud  # thinned
    thumbnail: NDArray[np.uint8]  # [15, 20]
    edge_blur_px: float


def keyframe_looks(
    image: RgbdImage,
    cloud_camera: PointCloud,
    keypoints_px: NDArray[np.float32],
    config: TrackingConfig,
) -> KeyframeLooks:
    """What needs no pose of a frame that becomes a keyframe.

    Args:
        image: colour and depth.
        cloud_camera: its surface.
        keypoints_px: where to look for normals, [M, 2].
        config: of the surface and of keyframes.
    """
    normals = normals_at(image.depth_m, keypoints_px, image.intrinsics, config.surface)
    return KeyframeLooks(
        landmark_normals_camera=normals,
        cloud_camera=thinned(cloud_camera, config.keyframe.max_cloud_points),
        thumbnail=thumbnail_of(image.rgb),
        edge_blur_px=edge_blur_px(image.rgb),
    )


def keyframe_data(
    looks: KeyframeLooks, observations: Observations, correction: Correction
) -> KeyframeData:
    """What a keyframe brings to the map."""
    return KeyframeData(
        observations=observations,
        landmark_normals_camera=looks.landmark_normals_camera,
        cloud_camera=looks.cloud_camera,
        thumbnail=looks.thumbnail,
        correction=correction,
        edge_blur_px=looks.edge_blur_px,
    )


def thinned(cloud: PointCloud, limit: int) -> PointCloud:
    """At most `limit` points, evenly from the whole image."""
    if len(cloud.points) <= limit:
        return cloud
    rows = np.linspace(0, len(cloud.points) - 1, limit).astype(np.int64)
    return PointCloud(cloud.points[rows], cloud.normals[rows])


def thumbnail_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey image of 20x15 pixels, [15, 20]."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, (20, 15), interpolation=cv2.INTER_AREA).astype(np.uint8)


def nearest_reference(
    T_world_camera: NDArray[np.float64],
    present: tuple[int, NDArray[np.float64]],
    others: list[tuple[int, NDArray[np.float64]]],
    depth_m: float,
) -> tuple[int, NDArray[np.float64]]:
    """The keyframe to tell a pose relative to: the present one unless another is much nearer."""

    def distance(keyframe: tuple[int, NDArray[np.float64]]) -> float:
        step = inverse(keyframe[1]) @ T_world_camera
        return float(np.linalg.norm(step[:3, 3])) + depth_m * angle_rad(step)

    best = min(others, key=distance, default=present)
    return best if distance(best) < 0.6 * distance(present) else present
