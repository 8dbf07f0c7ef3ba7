"""Poses as they come, and again when the map has moved them: what a robot follows."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.gateway.poses import TimedPose
from services.gateway.session import Session
from shared import se3
from shared.frames import Prior
from shared.tracks import KeyframePoses


@dataclass(frozen=True)
class WatchedPose:
    """A pose; `is_correction`: told before, and moved since by the map."""

    pose: TimedPose
    T_map_odom: NDArray[np.float64] | None  # [4, 4]; None without odometry of the device
    is_correction: bool = False


def correction(prior: Prior | None, keyframes: KeyframePoses) -> NDArray[np.float64] | None:
    """T_map_odom, [4, 4]: the drifting frame of the device's odometry in the map as it is now.

    REP 105: `odom` is smooth and drifts, `map` may jump; who publishes this transform keeps both.
    """
    if prior is None or prior.T_odom_camera is None:
        return None
    T_map_camera = prior.T_world_camera
    at = np.flatnonzero(keyframes.seqs == prior.reference_seq)
    if at.size and prior.T_reference_camera is not None:
        T_map_camera = keyframes.T_world_keyframes[at[0]] @ prior.T_reference_camera
    return T_map_camera @ se3.inverse(prior.T_odom_camera.matrix())


@contextmanager
def watched(session: Session) -> Iterator[asyncio.Queue[TimedPose]]:
    """A queue of each new pose, for `follow`; a slow reader loses the oldest."""
    queue = session.poses.watch()
    try:
        yield queue
    finally:
        session.poses.unwatch(queue)


async def follow(
    session: Session, queue: asyncio.Queue[TimedPose], look_every_s: float
) -> AsyncIterator[WatchedPose | None]:
    """Each pose of the queue, and the newest again when the map changed; None at quiet looks."""
    revision = session.owner.keyframes.revision
    while True:
        pose = await _next(queue, look_every_s)
        keyframes = session.owner.keyframes
        is_correction = pose is None and keyframes.revision > revision
        if is_correction and session.poses.newest[0] >= 0:
            pose = session.pose()
        revision = keyframes.revision
        T_map_odom = correction(session.prior, keyframes)
        yield None if pose is None else WatchedPose(pose, T_map_odom, is_correction)


async def _next(queue: asyncio.Queue[TimedPose], wait_s: float) -> TimedPose | None:
    try:
        async with asyncio.timeout(wait_s):
            return await queue.get()
    except TimeoutError:
        return None
