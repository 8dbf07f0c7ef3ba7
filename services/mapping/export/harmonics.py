"""Real spherical harmonics, as 3D Gaussian Splatting evaluates them, and fits to what was seen."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MAX_DEGREE = 3
CONSTANT = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    *(0.5900435899266435, 2.890611442640554, 0.4570457994644658),
    *(0.3731763325901154, 1.445305721320277),
)


def basis(directions: Tensor, degree: int) -> Tensor:
    """The (degree + 1)^2 functions at unit `directions` [N, 3] from camera to Gaussian, [N, B]."""
    x, y, z = directions.unbind(1)
    functions = [torch.full_like(x, CONSTANT)]
    if degree > 0:
        functions += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        functions += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        functions += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(functions, dim=1)


def mean_colour(harmonics: NDArray[np.float32]) -> NDArray[np.float32]:
    """The colour over all directions, [N, 3], of coefficients [N, B, 3]."""
    return 0.5 + np.float32(CONSTANT) * harmonics[:, 0]


class LeastSquares:
    """Coefficients that give observed values, for N things that are seen from directions.

    Values are sums of basis functions; each degree above 0 is held back by `ridge` times its
    degree squared, as if it had been seen to be 0 with that weight, so that directions that
    nobody saw stay near the mean colour.
    """

    def __init__(self, count: int, channels: int, degree: int, ridge: float) -> None:
        self._degree = degree
        size = (degree + 1) ** 2
        degrees = torch.tensor([d for d in range(degree + 1) for _ in range(2 * d + 1)])
        prior = ridge * degrees.float() ** 2
        prior[0] = 1e-6
        self._normal = torch.diag(prior).expand(count, size, size).clone()
        self._right = torch.zeros(count, size, channels)

    def add(self, index: Tensor, directions: Tensor, values: Tensor, weights: Tensor) -> None:
        """Things `index` [V] were seen along `directions` [V, 3] with `values` [V, channels].

        Directions go from camera to thing and have any length; `weights` [V] says how much each
        sight counts; no thing comes twice.
        """
        functions = basis(torch.nn.functional.normalize(directions, dim=1), self._degree)
        weighted = functions * weights[:, None]
        self._normal.index_add_(0, index, weighted[:, :, None] * functions[:, None])
        self._right.index_add_(0, index, weighted[:, :, None] * values[:, None])

    def solve(self) -> Tensor:
        """Coefficients, [N, (degree + 1)^2, channels]."""
        factor = torch.linalg.cholesky(self._normal)
        return torch.cholesky_solve(self._right, factor)
