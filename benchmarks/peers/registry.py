"""Which peers there are, and which of them this Python can import."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from benchmarks.peers.base import Peer


@dataclass(frozen=True)
class PeerEntry:
    """A peer by name; its library is imported only when it is run."""

    name: str
    library: str  # that pip installs
    module: str
    kind: str

    def make(self) -> Peer:
        """A fresh tracker.

        Raises:
            ImportError: its library is not installed.
        """
        return getattr(importlib.import_module(self.module), self.kind)()


PEERS = (
    PeerEntry("VGICP to map (small_gicp)", "small_gicp", "benchmarks.peers.vgicp", "Vgicp"),
    PeerEntry(
        "RGB-D odometry (OpenCV)", "cv2", "benchmarks.peers.opencv_odometry", "OpencvOdometry"
    ),
    PeerEntry(
        "hybrid odometry (Open3D)", "open3d", "benchmarks.peers.open3d_odometry", "Open3dHybrid"
    ),
    PeerEntry("dense SLAM 1 cm (Open3D)", "open3d", "benchmarks.peers.open3d_slam", "Open3dSlam"),
)
