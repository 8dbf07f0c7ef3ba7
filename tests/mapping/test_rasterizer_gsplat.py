"""The gsplat backend: the contract with the library, and equality with the CPU where CUDA is."""

import sys
from types import ModuleType

import numpy as np
import pytest
import torch

from services.mapping.rasterizer import (
    CpuRasterizer,
    Gaussians,
    GsplatRasterizer,
    View,
    rasterizer_for,
)
from services.mapping.rasterizer.reference import render
from shared.camera import Intrinsics
from shared.errors import ConfigError

CAMERA = Intrinsics(fx=100.0, fy=100.0, cx=20.0, cy=12.0, width=48, height=40)
VIEW = View(np.eye(4), CAMERA)


def cloud(count, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    fields = (
        torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0]),
        0.005 + 0.03 * torch.rand(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        0.1 + 0.8 * torch.rand(count, generator=generator),
        torch.rand(count, 3, generator=generator),
    )
    return Gaussians(*(field.to(dtype) for field in fields))


def trainable(gaussians, device="cpu"):
    return Gaussians(
        *(tensor.to(device, copy=True).requires_grad_() for tensor in gaussians.tensors())
    )


def differentiate(rendered, leaves):
    """Images, gradients at all fields, and the norms on the screen."""
    (rendered.colour.square().sum() + rendered.depth.sum() - rendered.alpha.sum()).backward()
    gradients = (tensor.grad for tensor in leaves.tensors())
    images = rendered.colour, rendered.depth, rendered.alpha
    return [*images, *gradients, rendered.screen.gradient_norm]


def library(radii_per_axis):
    """A module with gsplat's documented `rasterization`, computed by the float64 reference.

    Names and defaults are those of the versions 1.4 and 1.5, which differ in `radii`.
    """

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01,
        far_plane=1e10, radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16,
        backgrounds=None, render_mode="RGB",
    ):  # fmt: skip
        assert (near_plane, eps2d, packed, render_mode) == (0.2, 0.3, False, "RGB+D")
        fx, fy, cx, cy = (Ks[0, row, column].item() for row, column in _ENTRIES)
        camera = Intrinsics(fx, fy, cx - 0.5, cy - 0.5, width, height)
        doubled = (tensor.double() for tensor in (means, scales, quats, opacities, colors))
        rendered, _ = render(Gaussians(*doubled), View(viewmats[0], camera))
        radii = 3 * rendered.screen.visible.int()[None]
        means2d = means[None, :, :2] * 1.0
        images = torch.cat([rendered.colour, rendered.depth[..., None]], dim=-1)
        meta = {
            "radii": radii[..., None].expand(-1, -1, 2) if radii_per_axis else radii,
            "means2d": means2d,
            "width": width,
            "height": height,
        }
        reached = images.float() + 0.0 * means2d.sum()
        return reached[None], rendered.alpha.float()[None, ..., None], meta

    module = ModuleType("gsplat")
    module.rasterization = rasterization  # pyright: ignore[reportAttributeAccessIssue]
    return module


_ENTRIES = (0, 0), (1, 1), (0, 2), (1, 2)


@pytest.mark.parametrize("radii_per_axis", [False, True], ids=["1.4", "1.5"])
def test_the_call_fits_the_documented_library(monkeypatch, radii_per_axis):
    monkeypatch.setitem(sys.modules, "gsplat", library(radii_per_axis))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    leaves, twins = trainable(cloud(60)), trainable(cloud(60))

    rendered = rasterizer_for("cuda")(leaves, VIEW)
    found = differentiate(rendered, leaves)

    expected = differentiate(CpuRasterizer()(twins, VIEW), twins)
    assert rendered.screen.visible.shape == (60,)
    for tensor, twin in zip(found[:8], expected[:8], strict=True):
        assert (tensor - twin).norm() < 1e-3 * twin.norm()


def test_a_machine_with_cuda_but_without_gsplat_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    with pytest.raises(ConfigError, match=r"pip install .*cuda"):
        rasterizer_for("cuda:0")


def test_gsplat_without_a_cuda_device_is_told_to_use_the_cpu(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", library(True))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)

    with pytest.raises(ConfigError, match='use "cpu"'):
        rasterizer_for("cuda")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_gsplat_equals_the_cpu():
    leaves, twins = trainable(cloud(500), "cuda"), trainable(cloud(500))

    found = differentiate(GsplatRasterizer()(leaves, VIEW), leaves)
    expected = differentiate(CpuRasterizer()(twins, VIEW), twins)

    for tensor, twin in zip(found, expected, strict=True):
        assert (tensor.cpu() - twin).norm() < 1e-3 * twin.norm()
