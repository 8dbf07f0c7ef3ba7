"""What an entry must be before it is logged: one that cannot be applied would end every replay."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from shared.errors import InputError
from shared.frames import Prior
from shared.tracks import Advance, FrameRecord, KeyframeData, KeyframeLink, LoopConstraint

_FURTHEST_M = 10_000.0  # voxels of a map are numbered that far
_Shaped = Mapping[str, tuple[NDArray, tuple[int, ...]]]


def check_entry(entry: Advance) -> None:
    """Refuse frame and keyframe data that do not belong together or have impossible shapes.

    Raises:
        InputError: names the field.
    """
    if (entry.frame is None) != (entry.keyframe is None):
        raise InputError("keyframe", "a keyframe needs both its frame and its data")
    if entry.frame is not None and entry.frame.seq != entry.record.seq:
        raise InputError("frame.seq", f"is {entry.frame.seq}, the record's is {entry.record.seq}")
    _check_shapes("record", _shapes_of_record(entry.record))
    if entry.prior is not None:
        _check_shapes("prior", _shapes_of_prior(entry.prior))
    if entry.keyframe is not None:
        _check_shapes("keyframe", _shapes_of_keyframe(entry.keyframe))
        _check_shapes("keyframe", _shapes_of_ties(entry.keyframe.link, entry.keyframe.loop))
        cells = entry.keyframe.moving_cells
        if cells is not None and cells.ndim != 2:
            raise InputError("keyframe.moving_cells", f"must have two axes, got {cells.shape}")


def _check_shapes(where: str, arrays: _Shaped) -> None:
    for name, (array, shape) in arrays.items():
        if array.shape != shape:
            raise InputError(f"{where}.{name}", f"must have shape {shape}, got {array.shape}")
        if shape[-2:] == (4, 4) and not _is_rigid(array.reshape(-1, 4, 4)):
            reason = f"must be a rotation and a shift of at most {_FURTHEST_M:.0f} m"
            raise InputError(f"{where}.{name}", reason)
        if name == "correction.positions_world" and not np.isfinite(array).all():
            raise InputError(f"{where}.{name}", "must be finite")


def _is_rigid(T: NDArray[np.float64]) -> bool:
    """Whether transforms [N, 4, 4] are rotations (to a thousandth) and sane shifts."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    if not np.isfinite(T).all() or (np.abs(t) > _FURTHEST_M).any():
        return False
    products = R @ R.transpose(0, 2, 1)
    is_orthonormal = np.abs(products - np.eye(3)).max(initial=0.0) < 1e-3
    return bool(is_orthonormal and (np.linalg.det(R) > 0).all())


def _shapes_of_record(record: FrameRecord) -> _Shaped:
    return {
        "T_reference_camera": (record.T_reference_camera, (4, 4)),
        "T_world_camera": (record.T_world_camera, (4, 4)),
        "covariance": (record.covariance, (6, 6)),
    }


def _shapes_of_prior(prior: Prior) -> _Shaped:
    T_reference_camera = prior.T_reference_camera
    return {
        "T_world_camera": (prior.T_world_camera, (4, 4)),
        "T_before_last": (prior.T_before_last, (4, 4)),
    } | ({} if T_reference_camera is None else {"T_reference_camera": (T_reference_camera, (4, 4))})


def _shapes_of_keyframe(data: KeyframeData) -> _Shaped:
    seen, moved, cloud = data.observations, data.correction, data.cloud_camera
    features, points = seen.landmark_ids.size, cloud.points.size // 3
    poses, landmarks = moved.keyframe_seqs.size, moved.landmark_ids.size
    return {
        "observations.landmark_ids": (seen.landmark_ids, (features,)),
        "observations.keypoints_px": (seen.keypoints_px, (features, 2)),
        "observations.octaves": (seen.octaves, (features,)),
        "observations.depths_m": (seen.depths_m, (features,)),
        "observations.descriptors": (seen.descriptors, (features, 32)),
        "landmark_normals_camera": (data.landmark_normals_camera, (features, 3)),
        "cloud_camera.points": (cloud.points, (points, 3)),
        "cloud_camera.normals": (cloud.normals, (points, 3)),
        "thumbnail": (data.thumbnail, (15, 20)),
        "correction.keyframe_seqs": (moved.keyframe_seqs, (poses,)),
        "correction.T_world_keyframes": (moved.T_world_keyframes, (poses, 4, 4)),
        "correction.landmark_ids": (moved.landmark_ids, (landmarks,)),
        "correction.positions_world": (moved.positions_world, (landmarks, 3)),
        "correction.outliers": (moved.outliers, (moved.outliers.size // 2, 2)),
    }


def _shapes_of_ties(link: KeyframeLink | None, loop: LoopConstraint | None) -> _Shaped:
    """How a keyframe hangs on others: the pose graph is made of these."""
    shapes: dict[str, tuple[NDArray, tuple[int, ...]]] = {}
    if link is not None:
        shapes["link.information"] = link.information, (6, 6)
    if loop is not None:
        shapes["loop.T_earlier_keyframe"] = loop.T_earlier_keyframe, (4, 4)
        shapes["loop.information"] = loop.information, (6, 6)
        shapes["loop.landmark_ids"] = loop.landmark_ids, (loop.landmark_ids.size // 2, 2)
    return shapes
