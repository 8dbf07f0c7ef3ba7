"""What a rasterizer takes and gives: Gaussians, a view of them, and the rendered images.

Every backend follows the same definition, which `reference` spells out in float64:

* Gaussians nearer than `NEAR_M` are dropped;
* x/z and y/z are clamped in the Jacobian of the projection (not in the mean) to the field of
  view plus `FIELD_MARGIN` of it on each side, because the linearisation explodes beyond;
* `DILATION_PX2` is added to the diagonal of the projected covariance;
* alpha is cut at `ALPHA_MAX`, and a Gaussian below `ALPHA_MIN` leaves the pixel alone;
* a pixel stops before its transmittance would reach `TRANSMITTANCE_MIN`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shared.camera import Intrinsics
from shared.errors import InputError

NEAR_M = 0.2
FIELD_MARGIN = 0.15  # of the full field of view on each side: 1.3 fields in all
DILATION_PX2 = 0.3
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4

_WIDTHS = {"means": 3, "scales": 3, "quats_wxyz": 4, "opacities": 0, "colours": 3}


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic Gaussians as float32 tensors on one device.

    `means` [N, 3] metres, world; `scales` [N, 3] standard deviations, metres; `quats_wxyz` [N, 4],
    normalised by the rasterizer; `opacities` [N], 0 to 1; `colours` [N, 3].
    """

    means: Tensor
    scales: Tensor
    quats_wxyz: Tensor
    opacities: Tensor
    colours: Tensor

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five fields in order."""
        return self.means, self.scales, self.quats_wxyz, self.opacities, self.colours

    def check(self) -> None:
        """Refuse a wrong shape or type with an InputError that names the field."""
        count = len(self.means)
        for name, width in _WIDTHS.items():
            tensor = getattr(self, name)
            shape = (count, width) if width else (count,)
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
                found = f"{tensor.dtype} {list(tensor.shape)}"
                raise InputError(name, f"must be float32 {list(shape)}, got {found}")

    def check_finite(self) -> None:
        """Refuse NaN and infinity with an InputError that names the field."""
        for field in fields(self):
            if not torch.isfinite(getattr(self, field.name)).all():
                raise InputError(field.name, "must be finite")


@dataclass(frozen=True)
class View:
    """A camera that looks at the Gaussians; the images have the size of its intrinsics.

    `T_camera_world` [4, 4] maps world points to the camera. As a tensor that requires a gradient
    it receives dL/dT, whose last row is zero. `intrinsics` follow OpenCV: the centre of the first
    pixel is (0, 0).
    """

    T_camera_world: NDArray[np.float64] | Tensor
    intrinsics: Intrinsics

    def centre_px(self) -> tuple[float, float]:
        """The principal point where the *corner* of the first pixel is (0, 0).

        Rasterizers sample at half-integer positions; this is the only place that knows.
        """
        return self.intrinsics.cx + 0.5, self.intrinsics.cy + 0.5

    def slopes(self) -> tuple[float, float, float, float]:
        """Limits of x/z and y/z in the Jacobian: x least, x most, y least, y most."""
        k = self.intrinsics
        cx, cy = self.centre_px()
        margin_x, margin_y = FIELD_MARGIN * k.width, FIELD_MARGIN * k.height
        return (
            -(cx + margin_x) / k.fx,
            (k.width - cx + margin_x) / k.fx,
            -(cy + margin_y) / k.fy,
            (k.height - cy + margin_y) / k.fy,
        )

    def pose(self) -> Tensor:
        """`T_camera_world` as a tensor, in its own precision, checked.

        Raises:
            InputError: it is not 4x4 or not finite.
        """
        T = self.T_camera_world
        if not isinstance(T, Tensor):
            T = torch.from_numpy(np.array(T, np.float64))
        if tuple(T.shape) != (4, 4) or not bool(torch.isfinite(T).all()):
            raise InputError(
                "T_camera_world", f"must be 4x4 finite numbers, got shape {list(T.shape)}"
            )
        return T


@dataclass
class ScreenStatistics:
    """What growing and pruning want to know about each Gaussian in one view.

    `visible` [N] bool: it overlaps the image. `gradient_norm` [N]: norm of the loss gradient at
    its projected mean, in normalised device coordinates; None until the backward pass has run.
    """

    visible: Tensor
    gradient_norm: Tensor | None = None


@dataclass(frozen=True)
class Rendered:
    """Images of one view, without background: composite `colour + (1 - alpha) * background`.

    With w = alpha_i * transmittance: `colour` [H, W, 3] = sum(w c), `depth` [H, W] = sum(w z),
    metres, not divided by alpha, `alpha` [H, W] = sum(w).
    """

    colour: Tensor
    depth: Tensor
    alpha: Tensor
    screen: ScreenStatistics


# Each Gaussian's sum of an image [H, W, 4] under its weights w in a view: [N, 4].
WeightedSums = Callable[[Tensor], Tensor]


class Rasterizer(Protocol):
    """A backend; differentiable in every field of the Gaussians and in the pose of the view."""

    def __call__(self, gaussians: Gaussians, view: View) -> Rendered:
        """Render the Gaussians.

        Raises:
            InputError: a tensor has a wrong shape or type, or is not finite.
        """
        ...

    def with_sums(self, gaussians: Gaussians, view: View) -> tuple[Rendered, WeightedSums]:
        """Render without gradients, and keep what tells which Gaussian shows how much where.

        Raises:
            InputError: a tensor has a wrong shape or type, or is not finite.
        """
        ...


def sums_by_gradients(
    rasterizer: Rasterizer, gaussians: Gaussians, view: View
) -> tuple[Rendered, WeightedSums]:
    """`with_sums` of any backend: a pixel's derivative by a colour is that Gaussian's weight."""
    detached = Gaussians(*(tensor.detach() for tensor in gaussians.tensors()))
    colours = detached.colours.clone().requires_grad_()
    with torch.enable_grad():
        rendered = rasterizer(replace(detached, colours=colours), view)

    def sums(image: Tensor) -> Tensor:
        of_three, of_last = image[..., :3], image[..., 3:].expand(*image.shape[:2], 3)
        grad = torch.autograd.grad
        (first,) = grad(rendered.colour, colours, of_three.contiguous(), retain_graph=True)
        (last,) = grad(rendered.colour, colours, of_last.contiguous(), retain_graph=True)
        return torch.cat([first, last[:, :1]], dim=1)

    images = (rendered.colour.detach(), rendered.depth.detach(), rendered.alpha.detach())
    return Rendered(*images, screen=rendered.screen), sums
