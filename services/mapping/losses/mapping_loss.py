"""The mapping loss (paper Eq. 8) of one rendered view against a keyframe's image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from services.mapping.config import LossConfig
from services.mapping.losses.ssim import SsimTarget, ssim
from services.mapping.losses.ssim_torch import ssim_torch
from services.mapping.rasterizer import Rendered
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

MIN_DEPTH_ALPHA = 0.5  # where less is drawn, the rendered depth says little


@dataclass(frozen=True)
class Target:
    """A keyframe's image as the loss wants it."""

    colour: Tensor  # [H, W, 3], 0 to 1
    depth: Tensor  # [H, W], metres, 0 where there is none
    ssim: SsimTarget | None  # what comparisons on the CPU share
    intrinsics: Intrinsics
    moving: Tensor | None = None  # [H, W], pixels that do not count
    seen_share: float = 1.0  # of the pixels that do

    @staticmethod
    def of(image: RgbdImage, device: torch.device) -> Target:
        """Colour as floats, depth, and the target's part of SSIM."""
        colour = torch.from_numpy(image.rgb).to(device).float() / 255.0
        depth = torch.from_numpy(image.depth_m).to(device)
        shared = SsimTarget.of(colour) if device.type == "cpu" else None
        target = Target(colour, depth, shared, image.intrinsics)
        if image.moving is None:
            return target
        moving, seen_share = torch.from_numpy(image.moving).to(device), 1.0 - image.moving.mean()
        return replace(target, ssim=None, moving=moving, seen_share=max(seen_share, 1e-6))

    def similarity(self, image: Tensor) -> Tensor:
        """Mean SSIM of an image [H, W, 3] with this one."""
        if self.ssim is None and self.colour.device.type != "cpu":
            return ssim_torch(image, self.colour)
        return ssim(image, self.ssim or self.colour)

    def beside(self, image: Tensor) -> tuple[Tensor, Target]:
        """A render and this target as they are compared, equal and constant where things move.

        So these pixels have no error of their own, and the windows of SSIM that reach over them
        see what the map draws there and not what moves.
        """
        if self.moving is None:
            return image, self
        moving, drawn = self.moving[..., None], image.detach()
        colour = torch.where(moving, drawn, self.colour)
        return torch.where(moving, drawn, image), replace(self, colour=colour)


@dataclass(frozen=True)
class Appearance:
    """How a view's colours come about: background behind the Gaussians, then exposure."""

    background: Tensor  # [3]
    exposure: Tensor  # [2, 3], gain and bias

    def apply(self, colour: Tensor, alpha: Tensor) -> Tensor:
        """The image, [H, W, 3], of rendered colour [H, W, 3] and alpha [H, W]."""
        composite = colour + (1.0 - alpha)[..., None] * self.background
        return composite * self.exposure[0] + self.exposure[1]


@dataclass(frozen=True)
class Loss:
    """The loss to step on, and the view's PSNR."""

    total: Tensor
    squared_error: Tensor


def mapping_loss(
    rendered: Rendered, target: Target, appearance: Appearance, config: LossConfig
) -> Loss:
    """(1 - w) (L1 + q L2) + w (1 - SSIM) + depth L1, each a mean over the image's pixels."""
    image = appearance.apply(rendered.colour, rendered.alpha)
    image, target = target.beside(image)
    error = image - target.colour
    colour = error.abs().mean() + config.square * error.square().mean()
    total = (1.0 - config.ssim) * colour
    if config.ssim > 0:
        total = total + config.ssim * (1.0 - target.similarity(image))
    if config.depth > 0:
        total = total + config.depth * depth_error(rendered, target.depth, config)
    return Loss(total, error.detach().square().mean() / target.seen_share)


def depth_error(rendered: Rendered, depth: Tensor, config: LossConfig) -> Tensor:
    """L1 of depth, metres, summed where both are known and close, over all pixels."""
    is_known = (depth > 0) & (rendered.alpha > MIN_DEPTH_ALPHA)
    error = rendered.depth / rendered.alpha.clamp_min(MIN_DEPTH_ALPHA) - depth
    is_close = is_known & (error.detach().abs() < config.max_depth_error_m)
    return (error.abs() * is_close).mean()
