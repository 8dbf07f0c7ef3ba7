"""metrics.json: every key of the contract is always there, a number or null."""

from __future__ import annotations

import platform
import subprocess
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from pointslam.datasets.base import Sequence, is_held_out
from pointslam.evaluation.protocol import Scores, block, gsicp_block, novel_block
from pointslam.evaluation.trajectory import (
    AbsoluteErrors,
    Poses,
    RelativeErrors,
    absolute_errors,
    relative_errors,
)

_PACKAGES = ("pointslam", "numpy", "opencv-python-headless", "numba", "torch", "eclipse-zenoh")


@dataclass(frozen=True)
class TrajectoryScores:
    """Errors of the poses as they were told, and of the final ones; None without truth."""

    online: AbsoluteErrors | None
    final: AbsoluteErrors | None
    relative: RelativeErrors | None  # of the final poses


def score_trajectories(sequence: Sequence, online: Poses, final: Poses) -> TrajectoryScores:
    """Compare poses by frame index with the sequence's truth, where it has one."""
    known = {i: sequence.truth(i) for i in final.keys() | online.keys()}
    truth = {i: T for i, T in known.items() if T is not None}
    return TrajectoryScores(
        online=absolute_errors(online, truth),
        final=absolute_errors(final, truth),
        relative=relative_errors(final, truth),
    )


def trajectory_entries(scores: TrajectoryScores) -> dict[str, float | None]:
    """The entries of metrics.json about trajectories."""
    online, final, relative = scores.online, scores.final, scores.relative
    return {
        "ate_online_rmse_m": online.rmse_m if online else None,
        "ate_final_rmse_m": final.rmse_m if final else None,
        "ate_online_mean_m": online.mean_m if online else None,
        "ate_final_mean_m": final.mean_m if final else None,
        "rpe30_trans_m": relative.translation_rmse_m if relative else None,
        "rpe30_rot_deg": relative.rotation_rmse_deg if relative else None,
    }


def image_entries(scores: Scores, holdout: int) -> dict[str, dict[str, float | None]]:
    """The four blocks of image scores."""
    return {
        "all": block(scores.frames),
        "heldout": block(s for s in scores.frames if is_held_out(s.index, holdout)),
        "novel": novel_block(scores.views),
        "gsicp": gsicp_block(scores.frames),
    }


def tracking_entry(frame_ms: list[float], stages_ms: dict[str, float]) -> dict[str, Any]:
    """Times inside the tracking worker."""
    median = float(np.median(frame_ms)) if frame_ms else None
    p95 = float(np.percentile(frame_ms, 95)) if frame_ms else None
    return {"median": median, "p95": p95, "stages": stages_ms}


def map_entries(info: dict[str, Any]) -> dict[str, Any]:
    """What the map's owner says of itself."""
    return {
        "keyframes": info["keyframes"],
        "loops": info["loops"],
        "mapping_ms_per_iteration": {"median": info["iteration_ms"], "stages": info["stages_ms"]},
        "mapping_iterations": info["iterations"],
        "anchors": {
            "primary": info["primary_anchors"],
            "secondary": info["secondary_anchors"],
        },
        "map_mb": info["map_bytes"] / 1e6,
    }


def memory_entry(peak_rss_mb: dict[str, float] | None) -> dict[str, float | None]:
    """Peak memory by role; null when the services are not ours to look at."""
    peak = peak_rss_mb or {}
    return {role: peak.get(role) for role in ("gateway", "tracking", "mapping")}


def provenance() -> dict[str, Any]:
    """Versions of what ran, and the commit if this is a checkout."""
    versions = {"python": platform.python_version()}
    versions |= {package: _version(package) for package in _PACKAGES}
    return {"versions": versions, "git_commit": _git_commit()}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
