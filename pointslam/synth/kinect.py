"""What a Kinect of the first kind makes of exact depth.

Disparity in steps of 1/8 px (Khoshelham and Elberink 2012: the error grows with z squared), shadow
beside near objects where the projector does not reach, no readings past its range or at grazing
incidence, and ragged edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class KinectNoise:
    """The sensor's constants."""

    baseline_m: float = 0.075
    disparity_step_px: float = 0.125
    disparity_noise_px: float = 0.07
    min_depth_m: float = 0.4
    max_depth_m: float = 4.5
    edge_jitter_px: float = 0.7
    min_cosine: float = 0.12
    colour_noise: float = 1.6


def measure_depth(
    exact_m: Depth,
    cosine: Depth,
    camera: Intrinsics,
    noise: KinectNoise,
    rng: np.random.Generator,
) -> Depth:
    """Depth as measured, metres, [H, W]; 0 where there is no reading."""
    scale = camera.fx * noise.baseline_m
    jittered = _jitter_edges(exact_m, noise.edge_jitter_px, rng)
    with np.errstate(divide="ignore"):
        disparity = np.where(jittered > 0, scale / jittered, 0.0)
    error = cv2.GaussianBlur(rng.standard_normal(exact_m.shape).astype(np.float32), (0, 0), 0.8)
    noisy = disparity + noise.disparity_noise_px * error / max(float(error.std()), 1e-6)
    stepped = np.round(noisy / noise.disparity_step_px) * noise.disparity_step_px
    measured = scale / np.maximum(stepped, 1e-3)
    in_range = (measured >= noise.min_depth_m) & (measured <= noise.max_depth_m) & (exact_m > 0)
    # Near the limit of grazing incidence readings flicker rather than end in a line.
    is_seen = cosine > noise.min_cosine * rng.uniform(0.6, 1.8, exact_m.shape)
    is_lit = ~_is_shadowed(np.where(exact_m > 0, scale / np.maximum(exact_m, 1e-3), 0.0))
    return np.where(in_range & is_seen & is_lit, measured, 0.0).astype(np.float32)


def measure_colour(
    exact: NDArray[np.float32], noise: KinectNoise, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture with the sensor's grain, uint8 RGB."""
    grain = noise.colour_noise * rng.standard_normal(exact.shape).astype(np.float32)
    return np.clip(np.round(exact + grain), 0, 255).astype(np.uint8)


def _jitter_edges(depth_m: Depth, jitter_px: float, rng: np.random.Generator) -> Depth:
    """Look every pixel up a little beside itself: only edges change, and they become ragged."""
    rows, columns = np.indices(depth_m.shape, np.float32)
    shift = jitter_px * rng.standard_normal((2, *depth_m.shape)).astype(np.float32)
    looked_up = cv2.remap(
        depth_m,
        columns + shift[0],
        rows + shift[1],
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    is_edge = np.abs(looked_up - depth_m) > 0.03 * np.maximum(depth_m, 0.1)
    return np.where(is_edge, looked_up, depth_m)


def _is_shadowed(disparity: NDArray) -> NDArray[np.bool_]:
    """Pixels whose surface the projector, a baseline to the right, does not see."""
    column = np.arange(disparity.shape[1]) - disparity  # where the projector sees this pixel
    from_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    beyond = np.full_like(column, np.inf)
    beyond[:, :-1] = from_right[:, 1:]
    return beyond < column - 1.0
