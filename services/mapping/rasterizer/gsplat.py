"""The CUDA rasterizer: gsplat (Ye et al. 2024) behind the same function as the CPU one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from services.mapping.rasterizer.scene import (
    DILATION_PX2,
    NEAR_M,
    Gaussians,
    Rendered,
    ScreenStatistics,
    View,
    WeightedSums,
    sums_by_gradients,
)
from shared.errors import ConfigError


class GsplatRasterizer:
    """Renders Gaussians on a CUDA device."""

    def __init__(self) -> None:
        self._gsplat = _import_gsplat()

    def __call__(self, gaussians: Gaussians, view: View) -> Rendered:
        """Render the Gaussians; see `scene` for the definition.

        Raises:
            InputError: a tensor has a wrong shape or type, or is not finite.
        """
        gaussians.check()
        gaussians.check_finite()
        if not len(gaussians.means):
            return _nothing(gaussians, view)
        images, alphas, meta = self._gsplat.rasterization(
            means=gaussians.means,
            quats=gaussians.quats_wxyz,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colors=gaussians.colours,
            viewmats=view.pose().to(gaussians.means)[None],
            Ks=_camera_matrix(view).to(gaussians.means)[None],
            width=view.intrinsics.width,
            height=view.intrinsics.height,
            near_plane=NEAR_M,
            eps2d=DILATION_PX2,
            packed=False,
            render_mode="RGB+D",
        )
        return Rendered(images[0, ..., :3], images[0, ..., 3], alphas[0, ..., 0], _screen(meta))

    def with_sums(self, gaussians: Gaussians, view: View) -> tuple[Rendered, WeightedSums]:
        """Render without gradients; see `Rasterizer`."""
        return sums_by_gradients(self, gaussians, view)


def _import_gsplat() -> Any:
    try:
        import gsplat  # pyright: ignore[reportMissingImports] - only where there is CUDA
    except ImportError as error:
        raise ConfigError('device "cuda" needs gsplat: pip install "pointslam[cuda]"') from error
    if not torch.cuda.is_available():
        raise ConfigError('device "cuda" needs a CUDA device, torch finds none; use "cpu"')
    return gsplat


def _camera_matrix(view: View) -> Tensor:
    """Intrinsics with the first pixel's corner at (0, 0), [3, 3]."""
    matrix = torch.from_numpy(view.intrinsics.matrix())
    matrix[:2, 2] = torch.tensor(view.centre_px(), dtype=matrix.dtype)
    return matrix


def _screen(meta: dict[str, Any]) -> ScreenStatistics:
    """Statistics whose gradient norm a hook fills in when the backward pass reaches the means."""
    radii = meta["radii"][0]  # [N] in gsplat 1.4, [N, 2] since 1.5
    screen = ScreenStatistics((radii.reshape(len(radii), -1) > 0).any(-1))
    half_size = torch.tensor([meta["width"], meta["height"]]) / 2.0

    def note(gradient: Tensor) -> None:
        screen.gradient_norm = (gradient[0] * half_size.to(gradient)).norm(dim=-1)

    if meta["means2d"].requires_grad:
        meta["means2d"].register_hook(note)
    return screen


def _nothing(gaussians: Gaussians, view: View) -> Rendered:
    """Empty images that still belong to the graph of the Gaussians."""
    size = view.intrinsics.height, view.intrinsics.width
    zero = sum(tensor.sum() for tensor in gaussians.tensors())
    colour = gaussians.means.new_zeros(*size, 3) + zero
    image = gaussians.means.new_zeros(size) + zero
    visible = torch.zeros(0, dtype=torch.bool, device=image.device)
    return Rendered(colour, image, image, ScreenStatistics(visible))
