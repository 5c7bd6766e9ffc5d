# SPDX-License-Identifier: Apache-2.0
"""Structural similarity in the form for CUDA: what :mod:`ggwarp.kernels.losses.ssim` does, a pixel a thread.

Each quantity is a plane, so that neighbouring threads read neighbouring numbers. Windows are separable: along
rows the 15 means (x, y, x^2, y^2, xy of three channels), along columns what SSIM and its slopes need; the
adjoint likewise. Planes have a border of REACH zeros.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.losses.ssim import C1, C2, REACH, TAPS
from ggwarp.runtime.launch import block_size

wp.set_module_options({"enable_backward": False})

BINS = 8192
"""Sums that partial sums are folded to, before a single block adds them."""


@dataclass(frozen=True)
class PlaneWorkspace:
    """Scratch of the image losses for one image size, zeros at first; planes are [H + 2 REACH, W + 2 REACH].

    Attributes:
        colours: [6] planes: render and target, where a pixel's colour counts.
        blurred: [15] planes: means along rows, five of each channel; then of the slopes.
        slopes: [9] planes: of SSIM by the windows' means of x, of x^2 and of x y, for each channel.
        partials: [H W] vec4, partial sums.
        bins: [BINS] vec4.
    """

    colours: Any
    blurred: Any
    slopes: Any
    partials: Any
    bins: Any


@wp.func
def plane_of(planes: wp.array3d[float], plane: int) -> wp.array[float]:
    """A plane, border included, as one line: its stride is known, and addresses are short."""
    size = planes.shape[1] * planes.shape[2]
    first = wp.uint64(plane) * wp.uint64(size) * wp.uint64(4)
    return wp.array(ptr=planes.ptr + first, shape=(size,), dtype=float)


@wp.kernel
def _colours_kernel(
    width: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    colours: wp.array3d[float],
    partials: wp.array[wp.vec4],
):
    item = wp.tid()
    row = item / width
    column = item - row * width
    for c in range(3):
        colours[c, row + REACH, column + REACH] = image[c, row, column]
        colours[3 + c, row + REACH, column + REACH] = target[c, row, column]
    partials[item] = wp.vec4()


@wp.kernel
def _blur_colours_kernel(colours: wp.array3d[float], blurred: wp.array3d[float]):
    """Means along a row of one channel's x, y, x^2, y^2, xy."""
    c, row, column = wp.tid()
    at = (row + REACH) * colours.shape[2] + column
    x = plane_of(colours, c)
    y = plane_of(colours, 3 + c)
    a = x[at + REACH]
    b = y[at + REACH]
    mx = TAPS[REACH] * a
    my = TAPS[REACH] * b
    xx = TAPS[REACH] * (a * a)
    yy = TAPS[REACH] * (b * b)
    xy = TAPS[REACH] * (a * b)
    for k in range(REACH):
        a = x[at + k]
        b = y[at + k]
        d = x[at + 2 * REACH - k]
        e = y[at + 2 * REACH - k]
        mx += TAPS[k] * (a + d)
        my += TAPS[k] * (b + e)
        xx += TAPS[k] * (a * a + d * d)
        yy += TAPS[k] * (b * b + e * e)
        xy += TAPS[k] * (a * b + d * e)
    blurred[5 * c, row + REACH, column + REACH] = mx
    blurred[5 * c + 1, row + REACH, column + REACH] = my
    blurred[5 * c + 2, row + REACH, column + REACH] = xx
    blurred[5 * c + 3, row + REACH, column + REACH] = yy
    blurred[5 * c + 4, row + REACH, column + REACH] = xy


@wp.kernel
def _blur_slopes_kernel(slopes: wp.array3d[float], blurred: wp.array3d[float]):
    plane, row, column = wp.tid()
    at = (row + REACH) * slopes.shape[2] + column
    source = plane_of(slopes, plane)
    total = TAPS[REACH] * source[at + REACH]
    for k in range(REACH):
        total += TAPS[k] * (source[at + k] + source[at + 2 * REACH - k])
    blurred[plane, row + REACH, column + REACH] = total


@wp.func
def _down(plane: wp.array[float], at: int, stride: int) -> float:
    """Mean along a column, around ``at``."""
    total = TAPS[REACH] * plane[at]
    for k in range(REACH):
        total += TAPS[k] * (plane[at - (REACH - k) * stride] + plane[at + (REACH - k) * stride])
    return total


@wp.kernel
def _slopes_kernel(
    width: int,
    colours: wp.array3d[float],
    blurred: wp.array3d[float],
    slopes: wp.array3d[float],
    partials: wp.array[wp.vec4],
):
    """Finish the window; SSIM, its slopes by the means of (x, x^2, xy), and |x - y|."""
    item = wp.tid()
    row = item / width
    stride = colours.shape[2]
    at = (row + REACH) * stride + REACH + item - row * width
    l1 = float(0.0)
    dssim = float(0.0)
    for c in range(3):
        mx = _down(plane_of(blurred, 5 * c), at, stride)
        my = _down(plane_of(blurred, 5 * c + 1), at, stride)
        squares = _down(plane_of(blurred, 5 * c + 2), at, stride)
        squares += _down(plane_of(blurred, 5 * c + 3), at, stride)
        mxy = mx * my
        a1 = 2.0 * mxy + C1
        a2 = 2.0 * (_down(plane_of(blurred, 5 * c + 4), at, stride) - mxy) + C2
        m2 = mx * mx + my * my
        b1 = m2 + C1
        b2 = squares - m2 + C2
        inverse = 1.0 / (b1 * b2)
        similarity = a1 * a2 * inverse
        by_mean = plane_of(slopes, c)
        by_square = plane_of(slopes, 3 + c)
        by_product = plane_of(slopes, 6 + c)
        by_mean[at] = 2.0 * inverse * (my * (a2 - a1) + mx * similarity * (b1 - b2))
        by_square[at] = -2.0 * similarity * b1 * inverse
        by_product[at] = 2.0 * a1 * inverse
        x = plane_of(colours, c)
        y = plane_of(colours, 3 + c)
        l1 += wp.abs(x[at] - y[at])
        dssim += 1.0 - similarity
    partials[item] += wp.vec4(l1, dssim, 0.0, 0.0)


@wp.kernel
def _adjoint_kernel(
    width: int,
    l1_scale: float,
    ssim_scale: float,
    counts: wp.array2d[float],
    colours: wp.array3d[float],
    blurred: wp.array3d[float],
    d_image: wp.array3d[float],
):
    """Write the colour planes: blurred slopes chained to x, and the L1 term; 0 for pixels not counted."""
    item = wp.tid()
    row = item / width
    column = item - row * width
    stride = colours.shape[2]
    at = (row + REACH) * stride + REACH + column
    counted = float(1.0)
    if counts:
        counted = counts[row, column]
    for c in range(3):
        g = float(0.0)
        # False for NaN and infinity, too.
        if counted > 0.0 and counted < 1.0e6:
            x = plane_of(colours, c)
            y = plane_of(colours, 3 + c)
            # The slope by x^2 already holds the factor 2 of d(x^2) = 2 x dx.
            g += _down(plane_of(blurred, c), at, stride)
            g += x[at] * _down(plane_of(blurred, 3 + c), at, stride)
            g += y[at] * _down(plane_of(blurred, 6 + c), at, stride)
            g *= ssim_scale
            if x[at] > y[at]:
                g += l1_scale
            if x[at] < y[at]:
                g -= l1_scale
        d_image[c, row, column] = g


@wp.kernel
def _fold_kernel(count: int, stride: int, values: wp.array[wp.vec4], bins: wp.array[wp.vec4]):
    bin = wp.tid()
    total = wp.vec4()
    for i in range(bin, count, stride):
        total += values[i]
    bins[bin] = total


@wp.kernel
def _finish_kernel(used: int, scales: wp.vec4, bins: wp.array[wp.vec4], losses: wp.array[float]):
    """A block; on a CPU its only thread."""
    _, thread = wp.tid()
    total = wp.vec4()
    for i in range(thread, used, wp.block_dim()):
        total += bins[i]
    for k in range(4):
        of_block = wp.tile_sum(wp.tile(total[k]))
        if thread == 0:
            losses[k] = of_block[0] * scales[k]


def compare_colours(*, height: int, width: int, losses: Any, workspace: PlaneWorkspace, device: Any) -> None:
    """Evaluate L1 and SSIM of ``workspace.colours``, and sum the losses.

    Writes mean |x - y|, 1 - mean SSIM, and the sums in lanes 2 and 3 of ``workspace.partials``
    over H W to ``losses[0:4]``; leaves the slopes for :func:`compare_adjoint`.
    """
    w, pixels = workspace, height * width
    wp.launch(
        _blur_colours_kernel, dim=(3, height, width), inputs=[w.colours], outputs=[w.blurred], device=device
    )
    wp.launch(
        _slopes_kernel,
        dim=pixels,
        inputs=[width, w.colours, w.blurred],
        outputs=[w.slopes, w.partials],
        device=device,
    )
    used = min(BINS, pixels)
    wp.launch(_fold_kernel, dim=used, inputs=[pixels, used, w.partials], outputs=[w.bins], device=device)
    n = 1.0 / pixels
    scales = wp.vec4(n / 3.0, n / 3.0, n, n)
    block = block_size(_finish_kernel)
    wp.launch_tiled(
        _finish_kernel, dim=1, inputs=[used, scales, w.bins], outputs=[losses], block_dim=block, device=device
    )


def compare_adjoint(
    *,
    height: int,
    width: int,
    l1_weight: float,
    ssim_weight: float,
    d_image: Any,
    workspace: PlaneWorkspace,
    device: Any,
    counts: Any = None,
) -> None:
    """Write the gradient of l1_weight mean|x - y| + ssim_weight mean SSIM to planes 0-2 of ``d_image``.

    Args:
        counts: [H, W] depth, metres: pixels without have no gradient. None: all have one.
    """
    w, n = workspace, 1.0 / (3.0 * height * width)
    wp.launch(
        _blur_slopes_kernel, dim=(9, height, width), inputs=[w.slopes], outputs=[w.blurred], device=device
    )
    wp.launch(
        _adjoint_kernel,
        dim=height * width,
        inputs=[width, l1_weight * n, ssim_weight * n, counts, w.colours, w.blurred],
        outputs=[d_image],
        device=device,
    )


def ssim_forward(image: Any, target: Any, *, losses: Any, workspace: PlaneWorkspace, device: Any) -> None:
    """See :func:`ggwarp.kernels.losses.ssim.ssim_forward`."""
    height, width = image.shape[1], image.shape[2]
    wp.launch(
        _colours_kernel,
        dim=height * width,
        inputs=[width, image, target],
        outputs=[workspace.colours, workspace.partials],
        device=device,
    )
    compare_colours(height=height, width=width, losses=losses, workspace=workspace, device=device)
