"""The definition of rendering, dense in float64 torch: every pixel meets every Gaussian.

For tests of the fast backends on small problems; autograd differentiates it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from services.mapping.rasterizer.scene import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION_PX2,
    NEAR_M,
    TRANSMITTANCE_MIN,
    Gaussians,
    Rendered,
    ScreenStatistics,
    View,
)

# Float32 may take the other side of a threshold within this relative distance of it.
_UNDECIDED = 2e-4


class _Screen(NamedTuple):
    """Visible Gaussians on the screen, nearest first; `order` are their indices."""

    order: Tensor
    means_px: Tensor  # [V, 2]
    covariances_px2: Tensor  # [V, 2, 2]
    depths: Tensor  # [V]


class Reference(NamedTuple):
    """Rendered images, and the pixels whose value no threshold may flip in float32, [H, W]."""

    rendered: Rendered
    is_decided: Tensor


def render(gaussians: Gaussians, view: View) -> Reference:
    """Render float64 Gaussians; the definition is in `scene`."""
    screen = _project(gaussians, view)
    k = view.intrinsics
    values = gaussians.opacities[screen.order] * torch.exp(_exponents(screen, k.height, k.width))
    alpha = torch.where(values < ALPHA_MIN, 0.0, values.clamp(max=ALPHA_MAX))
    after = torch.cumprod(1.0 - alpha, dim=-1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], dim=-1)
    weights = torch.where(after > TRANSMITTANCE_MIN, alpha * before, 0.0)  # [H, W, V]
    rendered = Rendered(
        colour=weights @ gaussians.colours[screen.order],
        depth=weights @ screen.depths,
        alpha=weights.sum(-1),
        screen=_statistics(len(gaussians.means), screen, alpha),
    )
    return Reference(rendered, _is_decided(values, before, after))


def rotations(quats_wxyz: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats_wxyz, dim=-1).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, dim=-1).view(-1, 3, 3)


def _project(gaussians: Gaussians, view: View) -> _Screen:
    pose, k = view.pose().to(torch.float64), view.intrinsics
    points = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    order = torch.argsort(points[:, 2].detach(), stable=True)
    order = order[points[order, 2] >= NEAR_M]
    depths = points[order, 2]
    slopes = points[order, :2] / depths[:, None]
    focal = torch.tensor([k.fx, k.fy], dtype=torch.float64)
    centre = torch.tensor(view.centre_px(), dtype=torch.float64)
    shapes = rotations(gaussians.quats_wxyz[order]) * gaussians.scales[order, None, :]
    spread = _jacobians(slopes, depths, focal, view) @ pose[:3, :3] @ shapes  # [V, 2, 3]
    dilation = DILATION_PX2 * torch.eye(2, dtype=torch.float64)
    return _Screen(order, slopes * focal + centre, spread @ spread.mT + dilation, depths)


def _jacobians(slopes: Tensor, depths: Tensor, focal: Tensor, view: View) -> Tensor:
    """d(pixel)/d(camera point), [V, 2, 3], with clamped slopes."""
    limits = torch.tensor(view.slopes(), dtype=torch.float64).view(2, 2)
    clamped = torch.minimum(torch.maximum(slopes, limits[:, 0]), limits[:, 1])
    by_image_plane = torch.diag_embed(focal / depths[:, None])  # [V, 2, 2]
    by_depth = -focal * clamped / depths[:, None]
    return torch.cat([by_image_plane, by_depth[..., None]], dim=-1)


def _exponents(screen: _Screen, height: int, width: int) -> Tensor:
    """-1/2 d^T cov^-1 d at the centre of every pixel, [H, W, V]."""
    y = torch.arange(height, dtype=torch.float64)[:, None, None] + 0.5
    x = torch.arange(width, dtype=torch.float64)[None, :, None] + 0.5
    dx, dy = x - screen.means_px[:, 0], y - screen.means_px[:, 1]
    covariances = screen.covariances_px2
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return -0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)


def _statistics(count: int, screen: _Screen, alpha: Tensor) -> ScreenStatistics:
    """Which Gaussians touch a pixel; the gradient norm follows with the backward pass."""
    visible = torch.zeros(count, dtype=torch.bool)
    visible[screen.order] = (alpha > 0).flatten(0, 1).any(0)
    statistics = ScreenStatistics(visible)
    half_size = torch.tensor([alpha.shape[1], alpha.shape[0]]) / 2.0

    def note(gradient: Tensor) -> None:
        norms = torch.zeros(count, dtype=gradient.dtype)
        norms[screen.order] = (gradient * half_size).norm(dim=-1)
        statistics.gradient_norm = norms

    if screen.means_px.requires_grad:
        screen.means_px.register_hook(note)
    return statistics


def _is_decided(values: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Pixels where no Gaussian lies at one of the three thresholds."""
    alive = before > TRANSMITTANCE_MIN
    at_threshold = (
        _is_near(values, ALPHA_MIN)
        | _is_near(values, ALPHA_MAX)
        | (_is_near(after, TRANSMITTANCE_MIN) & (values >= ALPHA_MIN))
    )
    return ~(at_threshold & alive).any(-1).detach()


def _is_near(values: Tensor, threshold: float) -> Tensor:
    return (values / threshold - 1.0).abs() < _UNDECIDED
