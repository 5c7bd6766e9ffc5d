# SPDX-License-Identifier: Apache-2.0
"""Colour and depth losses of a rendered image, and their adjoint (GG-SLAM eqs. 6-7).

    L = colour_weight ((1 - l) mean|x - y| + l (1 - mean SSIM)) + depth_weight mean|D - D'| / d_max

x is the render and y the target, both multiplied by the mask "target depth > 0"; the depth
term uses the same mask, and may weigh each reading. Means are over *all* H W (3) values, masked
ones included, as in the papers' code.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.losses import ssim_planes
from ggwarp.kernels.losses.pixel_lines import BYTE_WEIGHT, RowWorkspace
from ggwarp.kernels.losses.rgbd_rows import rgbd_loss_by_rows
from ggwarp.kernels.losses.ssim import REACH
from ggwarp.kernels.losses.ssim_planes import PlaneWorkspace

wp.set_module_options({"enable_backward": False})

L1, DSSIM, DEPTH, MASKED, OBJECT, OBJECT_3D = range(6)
"""Places in the loss array: mean |x - y|, 1 - SSIM, mean depth error / d_max, share of pixels
in the mask; the last two are written by :mod:`ggwarp.kernels.identity.cross_entropy` and ``identity_kl``."""

LOSS_COUNT = 6


@wp.kernel
def _colours_kernel(
    width: int,
    mask_colour: int,
    with_depth: int,
    d_max: float,
    depth_scale: float,
    image: wp.array3d[wp.float32],
    colour: wp.array3d[wp.uint8],
    depth: wp.array2d[wp.float32],
    weights: wp.array2d[wp.uint8],
    colours: wp.array3d[wp.float32],
    partials: wp.array[wp.vec4],
    d_image: wp.array3d[wp.float32],
):
    """Lay out the masked colours of each pixel; depth term and its adjoint."""
    item = wp.tid()
    row = item / width
    column = item - row * width
    d = depth[row, column]
    valid = d > 0.0 and d < 1.0e6  # false for NaN and infinity, too
    for c in range(3):
        x = float(0.0)
        y = float(0.0)
        if mask_colour == 0 or valid:
            x = image[c, row, column]
            y = float(colour[row, column, c]) * (1.0 / 255.0)
        colours[c, row + REACH, column + REACH] = x
        colours[3 + c, row + REACH, column + REACH] = y
    error = float(0.0)
    gradient = float(0.0)
    if valid and with_depth != 0:
        weight = float(1.0)
        if weights.shape[0] > 0:
            weight = float(weights[row, column]) * BYTE_WEIGHT
        e = image[3, row, column] - d
        error = weight * wp.abs(e) / d_max
        gradient = weight * depth_scale * wp.where(e > 0.0, 1.0, wp.where(e < 0.0, -1.0, 0.0))
    if with_depth != 0:
        d_image[3, row, column] = gradient
    partials[item] = wp.vec4(0.0, 0.0, error, wp.where(valid, 1.0, 0.0))


@wp.kernel
def _clear_padding_kernel(height: int, width: int, planes: int, d_image: wp.array3d[wp.float32]):
    """A thread a pixel of the padding: beside the picture first, then below it."""
    item = wp.tid()
    beside = d_image.shape[2] - width
    row, column = int(0), int(0)
    if item < height * beside:
        row = item / beside
        column = width + item - row * beside
    else:
        left = item - height * beside
        row = height + left / d_image.shape[2]
        column = left % d_image.shape[2]
    for c in range(planes):
        d_image[c, row, column] = 0.0


@wp.kernel
def _total_kernel(weights: wp.array[wp.float32], losses: wp.array[wp.float32], totals: wp.array[wp.float64]):
    total = wp.float64(0.0)
    for k in range(losses.shape[0]):
        total += wp.float64(weights[k]) * wp.float64(losses[k])
    totals[0] += total
    totals[1] += wp.float64(1.0)


def add_total(losses: Any, *, weights: Any, totals: Any, device: Any) -> None:
    """Add an iteration's weighted loss to ``totals``, so that the host need not read each.

    Args:
        losses, weights: [LOSS_COUNT].
        totals: [2] float64, added to: the sum of the losses, and how many there were.
    """
    wp.launch(_total_kernel, dim=1, inputs=[weights, losses], outputs=[totals], device=device)


def rgbd_loss(
    image: Any,
    colour: Any,
    depth: Any,
    *,
    d_image: Any,
    losses: Any,
    workspace: PlaneWorkspace | RowWorkspace,
    colour_weight: float = 1.0,
    dssim: float = 0.2,
    depth_weight: float = 0.1,
    d_max: float = 10.0,
    mask_colour: bool = True,
    depth_weights: Any = None,
    device: Any,
) -> None:
    """Evaluate the colour and depth losses of a render and write their adjoint.

    Args:
        image: [C, Hp, Wp] render, C >= 3; plane 3, if any, is depth in metres.
        colour: [H, W, 3] uint8 target.
        depth: [H, W] target depth, metres; not in the mask where 0, NaN or infinite.
        d_image: [C, Hp, Wp]; planes 0-3 are written, zeros in the padding.
        losses: [LOSS_COUNT]; L1, DSSIM, DEPTH and MASKED are written, unweighted.
        workspace: scratch of this [H, W]; its kind decides how the work is cut.
        colour_weight, dssim, depth_weight: l_rgb, l_dssim and l_d of eqs. 5-6.
        d_max: depth unit of eq. 7, metres.
        mask_colour: False compares colour also where there is no depth.
        depth_weights: [H, W] uint8 how much each reading counts in the depth term, 64 for one; None: all
            alike.
        device: a Warp device.
    """
    l1_weight, ssim_weight = colour_weight * (1.0 - dssim), -colour_weight * dssim
    if isinstance(workspace, RowWorkspace):
        rgbd_loss_by_rows(
            *(image, colour, depth),
            d_image=d_image,
            losses=losses,
            workspace=workspace,
            l1_weight=l1_weight,
            ssim_weight=ssim_weight,
            depth_weight=depth_weight,
            d_max=d_max,
            mask_colour=mask_colour,
            depth_weights=depth_weights,
            device=device,
        )
        return
    height, width = colour.shape[0], colour.shape[1]
    with_depth = image.shape[0] > 3
    depth_scale = depth_weight / (d_max * height * width)
    wp.launch(
        _colours_kernel,
        dim=height * width,
        inputs=[
            *(width, int(mask_colour), int(with_depth), d_max, depth_scale),
            *(image, colour, depth, depth_weights),
        ],
        outputs=[workspace.colours, workspace.partials, d_image],
        device=device,
    )
    ssim_planes.compare_colours(height=height, width=width, losses=losses, workspace=workspace, device=device)
    ssim_planes.compare_adjoint(
        height=height,
        width=width,
        l1_weight=l1_weight,
        ssim_weight=ssim_weight,
        d_image=d_image,
        workspace=workspace,
        device=device,
        counts=depth if mask_colour else None,
    )
    planes = 4 if with_depth else 3
    padding = d_image.shape[1] * d_image.shape[2] - height * width
    wp.launch(_clear_padding_kernel, dim=padding, inputs=[height, width, planes, d_image], device=device)
