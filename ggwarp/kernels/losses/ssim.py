# SPDX-License-Identifier: Apache-2.0
"""Structural similarity of two images, L1 beside it, and their adjoint.

SSIM is Wang's: 11-tap Gaussian window of sigma 1.5, zero padding, data range 1; its mean is over
all H W 3 values. Here is the form for a CPU: one vec16 per pixel holds the 15 window statistics (x, y, x^2,
y^2, xy of three channels), so both separable passes are pure 16-wide arithmetic. Scratch arrays have a border
of REACH zeros. CUDA has :mod:`ggwarp.kernels.losses.ssim_planes`, mapping on a CPU
:mod:`ggwarp.kernels.losses.rgbd_rows`.
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

_weights = np.exp(-0.5 * (np.arange(2 * REACH + 1) - REACH) ** 2 / 1.5**2)
_vec11 = wp.types.vector(2 * REACH + 1, wp.float32)
TAPS = wp.constant(_vec11(*(_weights / _weights.sum()).tolist()))
C1 = wp.constant(wp.float32(0.01**2))
C2 = wp.constant(wp.float32(0.03**2))


@dataclass(frozen=True)
class PixelWorkspace:
    """Scratch for one image size.

    Attributes:
        statistics, blurred, slopes: [H + 2 REACH, W + 2 REACH] vec16, zeros at first.
        partials: [H] vec4, sums of rows.
    """

    statistics: Any
    blurred: Any
    slopes: Any
    partials: Any


@wp.func
def pack_statistics(x: wp.vec3, y: wp.vec3) -> vec16:
    s = vec16()
    for c in range(3):
        s[c] = x[c]
        s[3 + c] = y[c]
        s[6 + c] = x[c] * x[c]
        s[9 + c] = y[c] * y[c]
        s[12 + c] = x[c] * y[c]
    return s


@wp.kernel
def _statistics_kernel(
    offset: int,
    width: int,
    image: wp.array3d[wp.float32],
    target: wp.array3d[wp.float32],
    statistics: wp.array2d[vec16],
    partials: wp.array[wp.vec4],
):
    row = offset + wp.tid()
    for column in range(width):
        x = wp.vec3(image[0, row, column], image[1, row, column], image[2, row, column])
        y = wp.vec3(target[0, row, column], target[1, row, column], target[2, row, column])
        statistics[row + REACH, column + REACH] = pack_statistics(x, y)
    partials[row] = wp.vec4()


@wp.kernel
def _blur_rows_kernel(
    offset: int,
    width: int,
    source: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
):
    row = offset + wp.tid()
    y = row + REACH
    for x in range(width):
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
    width: int,
    statistics: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
    slopes: wp.array2d[vec16],
    partials: wp.array[wp.vec4],
):
    """Finish the window; SSIM, its slopes by the means of (x, x^2, xy), and |x - y|."""
    row = offset + wp.tid()
    l1 = float(0.0)
    dssim = float(0.0)
    for column in range(width):
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
    partials[row] += wp.vec4(l1, dssim, 0.0, 0.0)


@wp.kernel
def _adjoint_kernel(
    offset: int,
    width: int,
    l1_scale: float,
    ssim_scale: float,
    statistics: wp.array2d[vec16],
    blurred: wp.array2d[vec16],
    d_image: wp.array3d[wp.float32],
):
    """Write the colour planes: blurred slopes chained to x, plus the L1 term."""
    row = offset + wp.tid()
    for column in range(width):
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
            d_image[c, row, column] = g


@wp.kernel
def _finish_kernel(scales: wp.vec4, partials: wp.array[wp.vec4], losses: wp.array[wp.float32]):
    total = wp.vec4()
    for row in range(partials.shape[0]):
        total += partials[row]
    for k in range(4):
        losses[k] = total[k] * scales[k]


def compare_adjoint(
    *,
    height: int,
    width: int,
    l1_weight: float,
    ssim_weight: float,
    d_image: Any,
    workspace: PixelWorkspace,
    device: Any,
) -> None:
    """Write the gradient of l1_weight mean|x - y| + ssim_weight mean SSIM to planes 0-2 of ``d_image``."""
    n = 1.0 / (3.0 * height * width)
    launch_split(
        _blur_rows_kernel,
        height,
        inputs=[width, workspace.slopes],
        outputs=[workspace.blurred],
        device=device,
        min_piece=16,
    )
    launch_split(
        _adjoint_kernel,
        height,
        inputs=[width, l1_weight * n, ssim_weight * n, workspace.statistics, workspace.blurred],
        outputs=[d_image],
        device=device,
        min_piece=16,
    )


def ssim_forward(image: Any, target: Any, *, losses: Any, workspace: PixelWorkspace, device: Any) -> None:
    """Compare two images: ``losses[0]`` becomes mean |x - y|, ``losses[1]`` 1 - mean SSIM.

    Args:
        image, target: [3, H, W] float.
        losses: [>= 4] float.
        workspace: scratch of this [H, W]; keeps what :func:`compare_adjoint` needs.
        device: a Warp device.
    """
    height, width = image.shape[1], image.shape[2]
    w = workspace
    launch_split(
        _statistics_kernel,
        height,
        inputs=[width, image, target],
        outputs=[w.statistics, w.partials],
        device=device,
        min_piece=16,
    )
    launch_split(
        _blur_rows_kernel,
        height,
        inputs=[width, w.statistics],
        outputs=[w.blurred],
        device=device,
        min_piece=16,
    )
    launch_split(
        _slopes_kernel,
        height,
        inputs=[width, w.statistics, w.blurred],
        outputs=[w.slopes, w.partials],
        device=device,
        min_piece=16,
    )
    n = 1.0 / (height * width)
    scales = wp.vec4(n / 3.0, n / 3.0, n, n)
    wp.launch(_finish_kernel, dim=1, inputs=[scales, w.partials], outputs=[losses], device=device)
