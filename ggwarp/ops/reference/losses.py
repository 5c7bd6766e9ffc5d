# SPDX-License-Identifier: Apache-2.0
"""Colour and depth losses in torch float64: the oracle of ``kernels.loss``."""

from __future__ import annotations

import torch
from torch.nn.functional import conv2d


def ssim_map(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the SSIM of each value of ``x`` and ``y`` [3, H, W] (11 taps, sigma 1.5, zero padding)."""
    taps = torch.exp(-0.5 * (torch.arange(11, dtype=x.dtype) - 5.0) ** 2 / 1.5**2)
    taps = taps / taps.sum()
    window = (taps[:, None] * taps[None, :])[None, None]

    def mean(values: torch.Tensor) -> torch.Tensor:
        return conv2d(values[:, None], window, padding=5)[:, 0]

    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


def rgbd_losses(
    image: torch.Tensor,
    colour: torch.Tensor,
    depth: torch.Tensor,
    *,
    d_max: float = 10.0,
    mask_colour: bool = True,
    depth_weights: torch.Tensor | None = None,
) -> dict[str, torch.Tensor]:
    """Return the unweighted terms of GG-SLAM eqs. 6-7.

    Args:
        image: [C, H, W] colour and, when C > 3, depth in metres.
        colour: [H, W, 3] target in 0..1.
        depth: [H, W] target depth, metres; 0, NaN or infinite: masked out.
        d_max: depth unit, metres.
        mask_colour: apply the depth mask to both colours, too.
        depth_weights: [H, W] how much each reading counts in the depth term; None: all alike.

    Returns:
        ``l1``, ``dssim`` (1 - SSIM), ``depth`` and ``masked``, means over all pixels.
    """
    mask = (depth > 0) & torch.isfinite(depth)
    x, y = image[:3], colour.permute(2, 0, 1)
    if mask_colour:
        x, y = torch.where(mask, x, 0.0), torch.where(mask, y, 0.0)
    error = torch.zeros_like(x[0])
    if image.shape[0] > 3:
        error = torch.where(mask, image[3] - torch.where(mask, depth, 0.0), 0.0)
    return {
        "l1": (x - y).abs().mean(),
        "dssim": 1.0 - ssim_map(x, y).mean(),
        "depth": (error.abs() if depth_weights is None else depth_weights * error.abs()).mean() / d_max,
        "masked": mask.to(x.dtype).mean(),
    }
