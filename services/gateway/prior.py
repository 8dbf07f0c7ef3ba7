"""The prior of a session: what is known of the camera before the next frame."""

from __future__ import annotations

import dataclasses

import numpy as np

from shared import se3
from shared.frames import HAS_POSE, Frame, Prior
from shared.tracks import OpenReply, TrackResult


def next_prior(prior: Prior | None, frame: Frame, result: TrackResult) -> Prior | None:
    """The prior after a frame was answered."""
    is_keyframe = result.keyframe is not None
    if result.status not in HAS_POSE:
        return prior and dataclasses.replace(
            prior,
            lost_frames=prior.lost_frames + 1,
            frames_since_keyframe=prior.frames_since_keyframe + 1,
        )
    is_repeat = prior is not None and prior.frame_digest == frame.digest()
    if prior is not None and is_repeat and not is_keyframe:
        return _after_repeat(prior, result)
    dt_ns = 0 if prior is None else result.t_ns - prior.t_ns
    newest = prior.newest_keyframe_seq if prior else result.reference_seq
    since = prior.frames_since_keyframe + 1 if prior else 0
    return Prior(
        seq=result.seq,
        t_ns=result.t_ns,
        T_world_camera=result.T_world_camera,
        T_before_last=_motion(prior, result),
        before_last_dt_ns=dt_ns,
        reference_seq=result.reference_seq,
        newest_keyframe_seq=result.seq if is_keyframe else newest,
        lost_frames=0,
        frames_since_keyframe=0 if is_keyframe else since,
        T_odom_camera=frame.T_odom_camera,
        frame_digest=frame.digest(),
        T_reference_camera=result.T_reference_camera,
    )


def _after_repeat(prior: Prior, result: TrackResult) -> Prior:
    """The prior after the same image again: it tells nothing of how the camera moved since.

    Time, odometry and motion stay those of the image when it was new.
    """
    return dataclasses.replace(
        prior,
        seq=result.seq,
        T_world_camera=result.T_world_camera,
        reference_seq=result.reference_seq,
        lost_frames=0,
        frames_since_keyframe=prior.frames_since_keyframe + 1,
        T_reference_camera=result.T_reference_camera,
    )


def _motion(prior: Prior | None, result: TrackResult) -> np.ndarray:
    """Since the prior's frame, [4, 4]; the map may have moved between the two answers."""
    if result.T_last_camera is not None:
        return result.T_last_camera
    if prior is None:
        return np.eye(4)
    return se3.inverse(prior.T_world_camera) @ result.T_world_camera


def resumed_prior(opened: OpenReply) -> Prior | None:
    """The prior of a session taken up from its log.

    Of an older version's log it is the last pose, without motion.
    """
    if opened.prior is not None:
        return opened.prior
    last, keyframes = opened.last, opened.keyframe_poses.seqs
    if last is None or len(keyframes) == 0:
        return None
    newest = int(keyframes.max())
    return Prior(
        seq=last.seq,
        t_ns=last.t_ns,
        T_world_camera=last.T_world_camera,
        T_before_last=np.eye(4),
        before_last_dt_ns=0,
        reference_seq=last.reference_seq,
        newest_keyframe_seq=newest,
        lost_frames=0 if last.status in HAS_POSE else 1,
        frames_since_keyframe=max(0, last.seq - newest),
        T_reference_camera=last.T_reference_camera if last.status in HAS_POSE else None,
    )
