"""Baked Gaussians as arrays, in the axes that a file format wants."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.mapping.export.baking import BakedGaussians

Floats = NDArray[np.float32]
# Signs that basis functions 0 to 15 change by where y and z change theirs (see `harmonics.basis`).
_HALF_TURN_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


@dataclass(frozen=True)
class Splats:
    """Gaussians that show, with the colour per direction that `harmonics` gives (degree 0 to 3)."""

    means_m: Floats  # [N, 3]
    scales_m: Floats  # [N, 3], standard deviations
    quats_wxyz: Floats  # [N, 4], unit
    opacities: Floats  # [N], inside 0..1
    harmonics: Floats  # [N, (degree + 1)^2, 3]

    def __len__(self) -> int:
        return len(self.means_m)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    @staticmethod
    def of(baked: BakedGaussians) -> Splats:
        """What was baked, in the map's own axes (x right, y down, z forward)."""
        means, scales, quats, opacities, _ = (
            tensor.detach().cpu().numpy() for tensor in baked.gaussians.tensors()
        )
        norms = np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-12)
        return Splats(
            means,
            scales.clip(1e-9),
            quats / norms,
            opacities.clip(1e-6, 1.0 - 1e-6),
            baked.harmonics.cpu().numpy(),
        )

    def y_up(self) -> Splats:
        """In OpenGL's axes (x right, y up, z back): half a turn about x."""
        w, x, y, z = self.quats_wxyz.T
        return replace(
            self,
            means_m=self.means_m * np.array([1, -1, -1], np.float32),
            quats_wxyz=np.stack([-x, w, -z, y], axis=1),  # (0, 1, 0, 0) times the quaternion
            harmonics=self.harmonics * _HALF_TURN_SIGNS[: self.harmonics.shape[1], None],
        )
