"""What a failure cost a client: frames, keyframes, accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.players import Heard
from pointslam.client import Client

Poses = Mapping[int, NDArray[np.float64]]


@dataclass(frozen=True)
class Aftermath:
    """One session after its last frame, beside what its client was told.

    Attributes:
        lost: sent frames that have no reply and are not in the session either.
        refused: frames whose reply is an error.
        missing: keyframes that the client was told of, and that the map does not have.
        difference_m: largest distance between a told position and an undisturbed run's.
    """

    lost: list[int]
    refused: list[int]
    missing: list[int]
    difference_m: float


def aftermath(url: str, name: str, heard: Heard, undisturbed: Poses) -> Aftermath:
    """Compare what a client was told with the session as it is and as it would have been."""
    with Client(url) as client:
        records = client.session(name).trajectory()
    answered = {record.seq for record in records} | heard.replies.keys()
    keyframes = {record.seq for record in records if record.keyframe}
    return Aftermath(
        lost=sorted(heard.sent_s.keys() - answered),
        refused=[seq for seq, reply in heard.replies.items() if reply.error is not None],
        missing=sorted(set(heard.acknowledged_keyframes()) - keyframes),
        difference_m=difference_m(heard.poses(), undisturbed),
    )


def difference_m(poses: Poses, others: Poses) -> float:
    """Largest distance between the positions of frames that both have, metres."""
    both = poses.keys() & others.keys()
    return max((float(np.linalg.norm((poses[s] - others[s])[:3, 3])) for s in both), default=0.0)
