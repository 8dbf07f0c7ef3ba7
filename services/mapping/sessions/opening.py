"""What a request to open a session means: a new session, or one that exists already."""

from __future__ import annotations

import time

import numpy as np

from services.mapping.sessions.ledger import Ledger
from services.mapping.sessions.worker import LIVE, OFFLINE
from services.mapping.storage.folders import SessionRecord
from shared import codec
from shared.errors import ConflictError, InputError, NotFoundError
from shared.tracks import OpenReply, OpenRequest


def new_record(request: OpenRequest) -> SessionRecord:
    """The record of a session that a request creates.

    Raises:
        NotFoundError: it brings no calibration, so it means a session that there is not.
        InputError: the mode or the calibration cannot be used.
    """
    if request.calibration is None:
        raise NotFoundError(f"there is no session {request.session}")
    if request.mode not in (OFFLINE, LIVE):
        raise InputError("mode", f"must be {OFFLINE!r} or {LIVE!r}, got {request.mode[:40]!r}")
    request.calibration.check()
    return SessionRecord(
        session=request.session,
        mode=request.mode,
        seed=request.seed,
        epoch=0,
        created_ns=time.time_ns(),
        calibration=request.calibration,
        T_world_first=request.T_world_first,
    )


def check_same(record: SessionRecord, request: OpenRequest) -> None:
    """Creating a session again is fine if it means the same: the sender lost the reply.

    Raises:
        ConflictError: the session has another calibration, mode, seed or first pose.
    """
    is_other = {
        "mode": request.mode != record.mode,
        "seed": request.seed != record.seed,
        "calibration": codec.pack(request.calibration) != codec.pack(record.calibration),
        "first pose": not np.array_equal(request.T_world_first, record.T_world_first),
    }
    if any(is_other.values()):
        others = " and ".join(name for name, differs in is_other.items() if differs)
        raise ConflictError(f"session {request.session} exists with another {others}")


def opening_of(record: SessionRecord, mapper: str, ledger: Ledger) -> OpenReply:
    """What whoever opens or claims a session is told of it."""
    return OpenReply(
        session=record.session,
        mapper=mapper,
        epoch=record.epoch,
        mode=record.mode,
        map_revision=ledger.revision,
        created_ns=record.created_ns,
        calibration=record.calibration,
        T_world_first=record.T_world_first,
        last=ledger.last,
        prior=ledger.prior,
        keyframe_poses=ledger.poses(),
    )
