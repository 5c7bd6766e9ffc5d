# SPDX-License-Identifier: Apache-2.0
"""Structural similarity as a differentiable torch function."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ggwarp.kernels.losses import ssim as by_pixels
from ggwarp.kernels.losses import ssim_planes as by_planes
from ggwarp.kernels.losses.ssim import PixelWorkspace
from ggwarp.kernels.workspaces import allocate_ssim
from ggwarp.ops.tensors import on_stream_of


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean SSIM of two images (11-tap Gaussian window, sigma 1.5, zero padding, range 1).

    Float32 tensors are read in place; they are copied only where they are not contiguous.

    Args:
        image: [3, H, W] float32, nominally in 0..1; receives the gradient.
        target: [3, H, W] float32 on the same device; a constant.

    Returns:
        Scalar tensor, at most 1.

    Raises:
        ValueError: a tensor of another shape, type or device; ``target`` requires a gradient.
    """
    if image.ndim != 3 or image.shape[0] != 3 or image.numel() == 0 or image.dtype != torch.float32:
        raise ValueError(f"image: {image.dtype} {list(image.shape)}, but torch.float32 [3, H, W] is needed")
    if (target.shape, target.dtype, target.device) != (image.shape, image.dtype, image.device):
        raise ValueError(
            f"target: {target.dtype} {list(target.shape)} on {target.device}, but the image is "
            f"{image.dtype} {list(image.shape)} on {image.device}"
        )
    if target.requires_grad:
        raise ValueError("target requires a gradient, but it is a constant: pass target.detach()")
    wp.init()
    return _Ssim.apply(image, target)


def _view(tensor: Tensor) -> Any:
    return wp.from_torch(tensor.detach(), requires_grad=False)


def _form(workspace: Any) -> Any:
    """Return the module whose scratch it is."""
    return by_pixels if isinstance(workspace, PixelWorkspace) else by_planes


class _Ssim(torch.autograd.Function):
    """The forward pass leaves in its scratch what the backward pass needs, for any number of times."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        image, target = image.contiguous(), target.contiguous()
        height, width = ctx.size = image.shape[1:]
        losses = image.new_zeros(4)
        with on_stream_of(image):
            x = _view(image)
            ctx.workspace = allocate_ssim(height, width, device=x.device)
            _form(ctx.workspace).ssim_forward(
                x, _view(target), losses=_view(losses), workspace=ctx.workspace, device=x.device
            )
        return 1.0 - losses[1]

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, grad: Tensor
    ) -> tuple[Tensor | None, ...]:
        height, width = ctx.size
        d_image = grad.new_empty((3, height, width))
        with on_stream_of(grad):
            view = _view(d_image)
            _form(ctx.workspace).compare_adjoint(
                height=height,
                width=width,
                l1_weight=0.0,
                ssim_weight=1.0,
                d_image=view,
                workspace=ctx.workspace,
                device=view.device,
            )
        return d_image * grad, None
