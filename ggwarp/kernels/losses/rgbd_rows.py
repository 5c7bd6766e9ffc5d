# SPDX-License-Identifier: Apache-2.0
"""The colour and depth losses in the form for a CPU: an item is an image row, lanes are 16 pixels of it.

Three passes over the image, each reading what fits the second-level cache: colours, products and their
means along rows; means along columns, SSIM and its slopes, and the slopes' means along rows; these along
columns, and the gradient.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.losses.pixel_lines import (
    BAND,
    LINE,
    RowWorkspace,
    band_means,
    byte_weights,
    inside_image,
    load_line,
    plane_bytes,
    row_address,
    row_mean,
    store_line,
    store_product_means,
    total_of,
)
from ggwarp.kernels.losses.ssim import C1, C2, REACH
from ggwarp.kernels.math import VECTOR_OPTIONS, vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options(VECTOR_OPTIONS)

_MIN_ROWS = 16


@wp.kernel
def _colours_kernel(
    offset: int,
    mask_colour: int,
    with_depth: int,
    d_max: float,
    depth_scale: float,
    image: wp.array3d[float],
    colour: wp.array3d[wp.uint8],
    depth: wp.array2d[float],
    weights: wp.array2d[wp.uint8],
    colours: wp.array3d[vec16],
    means: wp.array3d[vec16],
    partials: wp.array[wp.vec4],
    d_image: wp.array3d[float],
):
    """Masked colours of a row and their means along it; the depth term and its adjoint."""
    row = offset + wp.tid()
    height = depth.shape[0]
    width = depth.shape[1]
    lines = colours.shape[2]
    across = image.shape[2] / 16
    plane = image.shape[1] * across
    image_lines = wp.array(ptr=image.ptr, shape=(image.shape[0] * plane,), dtype=vec16)
    d_image_lines = wp.array(ptr=d_image.ptr, shape=(image.shape[0] * plane,), dtype=vec16)
    bytes = wp.array(ptr=colour.ptr, shape=(3 * height * width,), dtype=wp.uint8)
    depths = wp.array(ptr=depth.ptr, shape=(height * width,), dtype=float)
    colour_bytes = plane_bytes(colours)
    errors = vec16()
    masked = vec16()
    j = int(0)
    while j < lines - 2:
        d = vec16()
        red = vec16()
        green = vec16()
        blue = vec16()
        for k in range(16):
            pixel = row * width + wp.min(16 * j + k, width - 1)
            d[k] = depths[pixel]
            red[k] = float(bytes[3 * pixel])
            green[k] = float(bytes[3 * pixel + 1])
            blue[k] = float(bytes[3 * pixel + 2])
        inside = inside_image(j, width)
        # A comparison is false for NaN.
        valid = vec16()
        counts = vec16()
        for k in range(16):
            valid[k] = wp.where(d[k] > 0.0 and d[k] < 1.0e6, inside[k], 0.0)
            counts[k] = wp.where(mask_colour == 0, inside[k], valid[k])
        at = row * across + j
        to = row_address(colours, 0, row) + wp.uint64(j) * LINE
        for c in range(3):
            x = image_lines[at + c * plane]
            for k in range(16):
                x[k] = wp.where(counts[k] > 0.0, x[k], 0.0)
            store_line(to, x)
            to += colour_bytes
        scaled = counts * (1.0 / 255.0)
        store_line(to, wp.cw_mul(red, scaled))
        store_line(to + colour_bytes, wp.cw_mul(green, scaled))
        store_line(to + wp.uint64(2) * colour_bytes, wp.cw_mul(blue, scaled))
        store_line(to + wp.uint64(3) * colour_bytes, counts)
        masked += valid
        if with_depth != 0:
            rendered = image_lines[at + 3 * plane]
            gradient = vec16()
            weight = byte_weights(weights, row, j)
            for k in range(16):
                error = wp.where(valid[k] > 0.0, rendered[k] - d[k], 0.0)
                errors[k] = errors[k] + weight[k] * wp.abs(error)
                gradient[k] = wp.where(error > 0.0, depth_scale, wp.where(error < 0.0, -depth_scale, 0.0))
            d_image_lines[at + 3 * plane] = wp.cw_mul(gradient, weight)
        j += 1
    partials[row] = wp.vec4(0.0, 0.0, total_of(errors) / d_max, total_of(masked))
    store_product_means(colours, means, row)


@wp.kernel
def _slopes_kernel(
    offset: int,
    height: int,
    width: int,
    colours: wp.array3d[vec16],
    means: wp.array3d[vec16],
    slopes: wp.array3d[vec16],
    slope_means: wp.array3d[vec16],
    partials: wp.array[wp.vec4],
):
    """SSIM of a band of rows and |x - y|; SSIM's slopes and their means along rows."""
    item = offset + wp.tid()
    first = item * BAND
    lines = colours.shape[2]
    row_bytes = wp.uint64(lines) * LINE
    mean_bytes = plane_bytes(means)
    colour_bytes = plane_bytes(colours)
    slope_bytes = plane_bytes(slopes)
    one = vec16(1.0)
    # A run-time number: Warp unrolls loops over constants, and compiles long.
    bands = BAND + wp.min(height, 0)
    l1 = vec16()
    dssim = vec16()
    c = int(0)
    while c < 3:
        mean_at = row_address(means, 4 * c, first)
        colour_at = row_address(colours, c, first)
        slope_at = row_address(slopes, c, first)
        j = int(0)
        while j < lines - 2:
            mean_x = band_means(mean_at, row_bytes)
            mean_y = band_means(mean_at + mean_bytes, row_bytes)
            squares = band_means(mean_at + wp.uint64(2) * mean_bytes, row_bytes)
            products = band_means(mean_at + wp.uint64(3) * mean_bytes, row_bytes)
            in_row = inside_image(j, width)
            to = slope_at
            at = colour_at
            r = int(0)
            while r < bands:
                mx = mean_x[r]
                my = mean_y[r]
                inside = in_row * wp.where(first + r < height, 1.0, 0.0)
                mxy = wp.cw_mul(mx, my)
                a1 = 2.0 * mxy + vec16(C1)
                a2 = 2.0 * (products[r] - mxy) + vec16(C2)
                m2 = wp.cw_mul(mx, mx) + wp.cw_mul(my, my)
                b1 = m2 + vec16(C1)
                b2 = squares[r] - m2 + vec16(C2)
                inverse = wp.cw_div(inside, wp.cw_mul(b1, b2))
                similarity = wp.cw_mul(wp.cw_mul(a1, a2), inverse)
                by_mean = wp.cw_mul(my, a2 - a1) + wp.cw_mul(wp.cw_mul(mx, similarity), b1 - b2)
                store_line(to, 2.0 * wp.cw_mul(inverse, by_mean))
                store_line(
                    to + wp.uint64(3) * slope_bytes, -2.0 * wp.cw_mul(wp.cw_mul(similarity, b1), inverse)
                )
                store_line(to + wp.uint64(6) * slope_bytes, 2.0 * wp.cw_mul(a1, inverse))
                dssim += wp.cw_mul(one - similarity, inside)
                l1 += wp.abs(load_line(at) - load_line(at + wp.uint64(3) * colour_bytes))
                to += row_bytes
                at += row_bytes
                r += 1
            mean_at += LINE
            colour_at += LINE
            slope_at += LINE
            j += 1
        c += 1
    partials[first] += wp.vec4(total_of(l1), total_of(dssim), 0.0, 0.0)
    p = int(0)
    while p < 9:
        row = first
        while row < first + BAND:
            source = row_address(slopes, p, row)
            to = row_address(slope_means, p, row + REACH)
            j = int(0)
            while j < lines - 2:
                store_line(to, row_mean(source))
                source += LINE
                to += LINE
                j += 1
            row += 1
        p += 1


@wp.kernel
def _gradient_kernel(
    offset: int,
    height: int,
    planes: int,
    l1_scale: float,
    ssim_scale: float,
    colours: wp.array3d[vec16],
    slope_means: wp.array3d[vec16],
    d_image: wp.array3d[float],
):
    """The colours' gradient: means of the slopes chained to x, and L1; zeros in the padding."""
    first = (offset + wp.tid()) * BAND
    lines = colours.shape[2]
    across = d_image.shape[2] / 16
    plane = d_image.shape[1] * across
    d_image_lines = wp.array(ptr=d_image.ptr, shape=(d_image.shape[0] * plane,), dtype=vec16)
    row_bytes = wp.uint64(lines) * LINE
    slope_bytes = plane_bytes(slope_means)
    colour_bytes = plane_bytes(colours)
    bands = BAND + wp.min(height, 0)
    c = int(0)
    while c < 3 and first < height:
        slope_at = row_address(slope_means, c, first)
        x_at = row_address(colours, c, first)
        counts_at = row_address(colours, 6, first)
        j = int(0)
        while j < lines - 2:
            by_mean = band_means(slope_at, row_bytes)
            by_square = band_means(slope_at + wp.uint64(3) * slope_bytes, row_bytes)
            by_product = band_means(slope_at + wp.uint64(6) * slope_bytes, row_bytes)
            at = x_at
            mask_at = counts_at
            r = int(0)
            while r < bands:
                if first + r < d_image.shape[1]:
                    x = load_line(at)
                    y = load_line(at + wp.uint64(3) * colour_bytes)
                    counts = load_line(mask_at)
                    # The slope by x^2 already holds the factor 2 of d(x^2) = 2 x dx.
                    g = by_mean[r] + wp.cw_mul(x, by_square[r]) + wp.cw_mul(y, by_product[r])
                    for k in range(16):
                        sign = wp.where(x[k] > y[k], l1_scale, wp.where(x[k] < y[k], -l1_scale, 0.0))
                        g[k] = wp.where(counts[k] > 0.0, ssim_scale * g[k] + sign, 0.0)
                    d_image_lines[c * plane + (first + r) * across + j] = g
                at += row_bytes
                mask_at += row_bytes
                r += 1
            slope_at += LINE
            x_at += LINE
            counts_at += LINE
            j += 1
        c += 1
    # Rows that hold no pixel; where a band has both, the depth's.
    for row in range(wp.max(first, height), wp.min(first + BAND, d_image.shape[1])):
        for p in range(planes):
            for j in range(across):
                d_image_lines[p * plane + row * across + j] = vec16()


@wp.kernel
def _sum_kernel(scales: wp.vec4, partials: wp.array[wp.vec4], losses: wp.array[float]):
    total = wp.vec4()
    for row in range(partials.shape[0]):
        total += partials[row]
    for k in range(4):
        losses[k] = total[k] * scales[k]


def rgbd_loss_by_rows(
    image: Any,
    colour: Any,
    depth: Any,
    *,
    d_image: Any,
    losses: Any,
    workspace: RowWorkspace,
    l1_weight: float,
    ssim_weight: float,
    depth_weight: float,
    d_max: float,
    mask_colour: bool,
    depth_weights: Any,
    device: Any,
) -> None:
    """Do what :func:`ggwarp.kernels.losses.rgbd.rgbd_loss` does, on a CPU.

    Args:
        l1_weight, ssim_weight: of mean |x - y| and of mean SSIM.
    """
    height, width = depth.shape
    n = 1.0 / (height * width)
    with_depth = image.shape[0] > 3
    w = workspace
    bands = -(-height // BAND)
    launch_split(
        _colours_kernel,
        height,
        inputs=[
            *(int(mask_colour), int(with_depth), d_max, depth_weight * n / d_max),
            *(image, colour, depth, depth_weights),
        ],
        outputs=[w.colours, w.means, w.partials, d_image],
        device=device,
        min_piece=_MIN_ROWS,
    )
    launch_split(
        _slopes_kernel,
        bands,
        inputs=[height, width, w.colours, w.means],
        outputs=[w.slopes, w.slope_means, w.partials],
        device=device,
        min_piece=_MIN_ROWS // BAND,
    )
    launch_split(
        _gradient_kernel,
        -(-d_image.shape[1] // BAND),
        inputs=[
            height,
            4 if with_depth else 3,
            l1_weight * n / 3.0,
            ssim_weight * n / 3.0,
            w.colours,
            w.slope_means,
        ],
        outputs=[d_image],
        device=device,
        min_piece=_MIN_ROWS // BAND,
    )
    scales = wp.vec4(n / 3.0, n / 3.0, n, n)
    wp.launch(_sum_kernel, dim=1, inputs=[scales, w.partials], outputs=[losses], device=device)
