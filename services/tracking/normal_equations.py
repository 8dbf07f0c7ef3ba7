"""Normal equations of a registration, and which directions of the pose they tell of.

Noisy normals seem to hold a pose even along what the geometry leaves open, as in a corridor, and
the registration slides there (Hatleskog and Alexis, RA-L 2024, on the effect). A point's own
normal has other noise than the map's, so the product of the two Jacobians counts what is signal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MIN_SIGNAL = 0.5  # of the Hessian along a direction: less is mostly noise


@dataclass(frozen=True)
class NormalEquations:
    """Of a camera twist at a pose, in depth sigmas."""

    H: NDArray[np.float64]  # [6, 6]
    signal: NDArray[np.float64]  # [6, 6], what of H the normals of map and frame both say
    b: NDArray[np.float64]  # [6]
    overlap: float
    residual_scale: float

    def projector(self, min_share: float) -> NDArray[np.float64]:
        """Leaves of a twist what the geometry holds, [6, 6]."""
        basis = known_directions(self.H, self.signal, min_share)
        return basis @ basis.T @ self.H


def known_directions(
    H: NDArray[np.float64], signal: NDArray[np.float64], min_share: float
) -> NDArray[np.float64]:
    """Twists that the geometry holds, in columns, conjugate: basis.T @ H @ basis = I.

    Nothing is known where H is below a share of its largest eigenvalue (Zhang et al., ICRA 2016),
    or mostly noise.
    """
    values, vectors = np.linalg.eigh(H)
    keep = values > min_share * max(values[-1], 1e-12)
    whiten = vectors[:, keep] / np.sqrt(values[keep])
    shares, axes = np.linalg.eigh(whiten.T @ signal @ whiten)
    return whiten @ axes[:, shares > _MIN_SIGNAL]
