# SPDX-License-Identifier: Apache-2.0
"""Structural similarity of two images, L1 beside it, and their adjoint.

SSIM is Wang's: 11-tap Gaussian window of sigma 1.5, zero padding, data range 1; its mean is over
all H W 3 values. One vec16 per pixel holds the 15 window statistics (x, y, x^2, y^2, xy of three
channels), so both separable passes are pure 16-wide arithmetic; lane 15 is 1 where the pixel's
colour counts. Scratch arrays have a border of REACH zeros.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

REACH = 5
"""Half width of the window: the zero border of the scratch arrays, pixels."""

BINS = 1024
"""Length of ``LossWorkspace.bins``."""

_weights = np.exp(-0.5 * (np.arange(2 * REACH + 1) - REACH) ** 2 / 1.5**2)
_vec11 = wp.types.vector(2 * REACH + 1, wp.float32)
TAPS = wp.constant(_vec11(*(_weights / _weights.sum()).tolist()))
C1 = wp.constant(wp.float32(0.01**2))
C2 = wp.constant(wp.float32(0.03**2))


@dataclass(frozen=True)
class LossWorkspace:
    """Scratch of the image losses for one image size.

    Attributes:
        statistics, blurred, slopes: [H + 2 REACH, W + 2 REACH] vec16, zeros at first.
        partials: [items] vec4, partial sums; items = H :func:`pieces_per_row`.
        bins: [BINS] vec4.
    """

    statistics: Any
    blurred: Any
    slopes: Any
    partials: Any
    bins: Any


@wp.func
def pack_statistics(x: wp.vec3, y: wp.vec3) -> vec16:
    s = vec16()
    for c in range(3):
        s[c] = x[c]
        s[3 + c] = y[c]
        s[6 + c] = x[c] * x[c]
        s[9 + c] = y[c] * y[c]
        s[12 + c] = x[c] * y[c]
    s[15] = 1.0
    return s


@wp.kernel
def _statistics_kernel(
    offset: int,
    pieces: int,
    width: int,
    image: wp.array3d[wp.float32],
    target: wp.array3d[wp.float32],
    statistics: wp.array2d[vec16],
    partials: wp.array[wp.vec4],
):
    item = offset + wp.tid()
    row = item / pieces
    piece = item - row * pieces
    for column in range(width * piece / pieces, width * (piece + 1) / pieces):
        x = wp.vec3(image[0, row, column], image[1, row, column], image[2, row, column])
        y = wp.vec3(target[0, row, column], target[1, row, column], target[2, row, column])
        statistics[row + REACH, column + REACH] = pack_statistics(x, y)
    partials[item] = wp.vec4()


@wp.kernel
def _blur_rows_kernel(
    offset: int,
    pieces: int,
    width: int,
    source: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
):
    item = offset + wp.tid()
    row = item / pieces
    piece = item - row * pieces
    y = row + REACH
    for x in range(width * piece / pieces, width * (piece + 1) / pieces):
        total = TAPS[REACH] * source[y, x + REACH]
        for k in range(REACH):
            total += TAPS[k] * (source[y, x + k] + source[y, x + 2 * REACH - k])
        blurred[y, x + REACH] = total


@wp.func
def _blur_column(source: wp.array2d[vec16], row: int, x: int) -> vec16:
    total = TAPS[REACH] * source[row + REACH, x]
    for k in range(REACH):
        total += TAPS[k] * (source[row + k, x] + source[row + 2 * REACH - k, x])
    return total


@wp.kernel
def _slopes_kernel(
    offset: int,
    pieces: int,
    width: int,
    statistics: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
    slopes: wp.array2d[vec16],
    partials: wp.array[wp.vec4],
):
    """Finish the window; SSIM, its slopes by the means of (x, x^2, xy), and |x - y|."""
    item = offset + wp.tid()
    row = item / pieces
    piece = item - row * pieces
    l1 = float(0.0)
    dssim = float(0.0)
    for column in range(width * piece / pieces, width * (piece + 1) / pieces):
        w = _blur_column(blurred, row, column + REACH)
        s = statistics[row + REACH, column + REACH]
        slope = vec16()
        for c in range(3):
            mx = w[c]
            my = w[3 + c]
            mxy = mx * my
            a1 = 2.0 * mxy + C1
            a2 = 2.0 * (w[12 + c] - mxy) + C2
            m2 = mx * mx + my * my
            b1 = m2 + C1
            b2 = w[6 + c] + w[9 + c] - m2 + C2
            inverse = 1.0 / (b1 * b2)
            similarity = a1 * a2 * inverse
            slope[c] = 2.0 * inverse * (my * (a2 - a1) + mx * similarity * (b1 - b2))
            slope[3 + c] = -2.0 * similarity * b1 * inverse
            slope[6 + c] = 2.0 * a1 * inverse
            l1 += wp.abs(s[c] - s[3 + c])
            dssim += 1.0 - similarity
        slopes[row + REACH, column + REACH] = slope
    partials[item] += wp.vec4(l1, dssim, 0.0, 0.0)


@wp.kernel
def _adjoint_kernel(
    offset: int,
    pieces: int,
    width: int,
    l1_scale: float,
    ssim_scale: float,
    statistics: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
    d_image: wp.array3d[wp.float32],
):
    """Write the colour planes: blurred slopes chained to x, plus the L1 term."""
    item = offset + wp.tid()
    row = item / pieces
    piece = item - row * pieces
    for column in range(width * piece / pieces, width * (piece + 1) / pieces):
        w = _blur_column(blurred, row, column + REACH)
        s = statistics[row + REACH, column + REACH]
        for c in range(3):
            x = s[c]
            y = s[3 + c]
            # slopes[3 + c] already holds the factor 2 of d(x^2) = 2 x dx.
            g = ssim_scale * (w[c] + x * w[3 + c] + y * w[6 + c])
            if x > y:
                g += l1_scale
            if x < y:
                g -= l1_scale
            d_image[c, row, column] = wp.where(s[15] > 0.0, g, 0.0)


@wp.kernel
def _fold_kernel(count: int, partials: wp.array[wp.vec4], bins: wp.array[wp.vec4]):
    bin = wp.tid()
    total = wp.vec4()
    for i in range(bin, count, bins.shape[0]):
        total += partials[i]
    bins[bin] = total


@wp.kernel
def _finish_kernel(used: int, scales: wp.vec4, bins: wp.array[wp.vec4], losses: wp.array[wp.float32]):
    total = wp.vec4()
    for i in range(used):
        total += bins[i]
    for k in range(4):
        losses[k] = total[k] * scales[k]


def pieces_per_row(width: int, device: Any) -> int:
    """Return into how many items a row is cut: whole rows on the CPU, single pixels on CUDA."""
    return 1 if wp.get_device(device).is_cpu else width


def compare_statistics(
    *, height: int, width: int, losses: Any, workspace: LossWorkspace, device: Any
) -> None:
    """Evaluate L1 and SSIM from ``workspace.statistics``, and sum the losses.

    Writes mean |x - y|, 1 - mean SSIM, and the sums in lanes 2 and 3 of ``workspace.partials``
    over H W to ``losses[0:4]``; leaves the slopes for :func:`compare_adjoint`.
    """
    pieces = pieces_per_row(width, device)
    items = height * pieces
    launch_split(
        _blur_rows_kernel,
        items,
        inputs=[pieces, width, workspace.statistics],
        outputs=[workspace.blurred],
        device=device,
        min_piece=16,
    )
    launch_split(
        _slopes_kernel,
        items,
        inputs=[pieces, width, workspace.statistics, workspace.blurred],
        outputs=[workspace.slopes, workspace.partials],
        device=device,
        min_piece=16,
    )
    bins = workspace.bins
    wp.launch(_fold_kernel, dim=min(items, BINS), inputs=[items, workspace.partials, bins], device=device)
    n = 1.0 / (height * width)
    scales = wp.vec4(n / 3.0, n / 3.0, n, n)
    wp.launch(_finish_kernel, dim=1, inputs=[min(items, BINS), scales, bins, losses], device=device)


def compare_adjoint(
    *,
    height: int,
    width: int,
    l1_weight: float,
    ssim_weight: float,
    d_image: Any,
    workspace: LossWorkspace,
    device: Any,
) -> None:
    """Write the gradient of l1_weight mean|x - y| + ssim_weight mean SSIM to planes 0-2 of ``d_image``."""
    pieces = pieces_per_row(width, device)
    n = 1.0 / (3.0 * height * width)
    launch_split(
        _blur_rows_kernel,
        height * pieces,
        inputs=[pieces, width, workspace.slopes],
        outputs=[workspace.blurred],
        device=device,
        min_piece=16,
    )
    launch_split(
        _adjoint_kernel,
        height * pieces,
        inputs=[pieces, width, l1_weight * n, ssim_weight * n, workspace.statistics, workspace.blurred],
        outputs=[d_image],
        device=device,
        min_piece=16,
    )


def ssim_forward(image: Any, target: Any, *, losses: Any, workspace: LossWorkspace, device: Any) -> None:
    """Compare two images: ``losses[0]`` becomes mean |x - y|, ``losses[1]`` 1 - mean SSIM.

    Args:
        image, target: [3, H, W] float.
        losses: [>= 4] float.
        workspace: scratch of this [H, W]; keeps what :func:`compare_adjoint` needs.
        device: a Warp device.
    """
    height, width = image.shape[1], image.shape[2]
    pieces = pieces_per_row(width, device)
    launch_split(
        _statistics_kernel,
        height * pieces,
        inputs=[pieces, width, image, target],
        outputs=[workspace.statistics, workspace.partials],
        device=device,
        min_piece=16,
    )
    compare_statistics(height=height, width=width, losses=losses, workspace=workspace, device=device)
