# SPDX-License-Identifier: Apache-2.0
"""Images of a CPU's loss as lines of 16 pixels, and windows over them.

Planes of scratch are [p, rows, lines] vec16: a line is 16 pixels, a row begins and ends with a line of
zeros. Windows along a row are read from unaligned addresses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.losses.ssim import REACH, TAPS
from ggwarp.kernels.math import VECTOR_OPTIONS, vec16

wp.set_module_options(VECTOR_OPTIONS)

BAND = 4
"""Rows whose means along columns are taken together: they share most of what they read."""

BYTE_WEIGHT = 1.0 / 64.0
"""Unit of weights that are kept as bytes: up to 4."""

LINE = wp.constant(wp.uint64(64))
"""Bytes of a line."""

FLOAT = wp.constant(wp.uint64(4))
REACH_BYTES = wp.constant(wp.uint64(4 * REACH))

band = wp.types.matrix((BAND, 16), wp.float32)

WINDOW = 2 * REACH + 1

_vec17 = wp.types.vector(WINDOW + 2 * BAND - 2, wp.float32)
_PADDED_TAPS = wp.constant(_vec17(*[0.0] * (BAND - 1), *TAPS, *[0.0] * (BAND - 1)))


@dataclass(frozen=True)
class RowWorkspace:
    """Scratch of the losses for one image size; zeros at first.

    Attributes:
        colours: [7, H', L] vec16: render (3), target (3), 1 where a pixel's colour counts; H' is H rounded
            up to whole bands.
        means: [12, H' + 2 REACH, L]: along rows of x, y, x^2 + y^2 and x y of each channel.
        slopes: [9, H', L]: of SSIM by the windows' means of x, x^2 and x y of each channel.
        slope_means: [9, H' + 2 REACH, L]: along rows.
        partials: [H'] vec4, sums of rows and of bands.
    """

    colours: Any
    means: Any
    slopes: Any
    slope_means: Any
    partials: Any


def lines_per_row(width: int) -> int:
    """Return L, the lines of a row of ``width`` pixels: a zero line before and after it."""
    return -(-width // 16) + 2


@wp.func
def load_line(address: wp.uint64) -> vec16:
    return wp.array(ptr=address, shape=(1,), dtype=vec16)[0]


@wp.func
def store_line(address: wp.uint64, v: vec16):
    line = wp.array(ptr=address, shape=(1,), dtype=vec16)
    line[0] = v


@wp.func
def row_address(planes: wp.array3d[vec16], plane: int, row: int) -> wp.uint64:
    """Of a row's first pixels."""
    lines = planes.shape[2]
    return planes.ptr + wp.uint64((plane * planes.shape[1] + row) * lines + 1) * LINE


@wp.func
def plane_bytes(planes: wp.array3d[vec16]) -> wp.uint64:
    return wp.uint64(planes.shape[1] * planes.shape[2]) * LINE


@wp.func
def inside_image(line: int, width: int) -> vec16:
    """1 in the lanes of ``line`` that are pixels of the image, else 0."""
    inside = vec16()
    for k in range(16):
        inside[k] = wp.where(line * 16 + k < width, 1.0, 0.0)
    return inside


@wp.func
def byte_weights(image: wp.array2d[wp.uint8], row: int, line: int) -> vec16:
    """``image`` in the lanes of ``line`` of a row, in units of ``BYTE_WEIGHT``; 1 where there is no image."""
    weights = vec16(1.0)
    if image.shape[0] > 0:
        for k in range(16):
            column = wp.min(16 * line + k, image.shape[1] - 1)
            weights[k] = float(image[row, column]) * BYTE_WEIGHT
    return weights


@wp.func
def total_of(v: vec16) -> float:
    return wp.dot(v, vec16(1.0))


@wp.func
def band_means(address: wp.uint64, stride: wp.uint64) -> band:
    """Means over the windows' rows of a line in BAND rows; ``address`` is in the first window's first row."""
    means = band()
    at = address
    k = int(0)
    while k < WINDOW + BAND - 1:
        line = load_line(at)
        for r in range(BAND):
            means[r] += line * _PADDED_TAPS[k + BAND - 1 - r]
        at += stride
        k += 1
    return means


@wp.func
def row_mean(address: wp.uint64) -> vec16:
    """Means over the windows' columns of a line."""
    total = load_line(address) * TAPS[REACH]
    left = address - REACH_BYTES
    right = address + REACH_BYTES
    for k in range(REACH):
        total += (load_line(left) + load_line(right)) * TAPS[k]
        left += FLOAT
        right -= FLOAT
    return total


@wp.func
def store_product_means(colours: wp.array3d[vec16], means: wp.array3d[vec16], row: int):
    """Write the means along a row of x, y, x^2 + y^2 and x y of each channel."""
    tap_memory = wp.zeros(shape=WINDOW, dtype=float)
    taps = wp.array(ptr=tap_memory.ptr, shape=(WINDOW,), dtype=float)
    for i in range(WINDOW):
        taps[i] = TAPS[i]
    lines = colours.shape[2]
    mean_bytes = plane_bytes(means)
    c = int(0)
    while c < 3:
        x_at = row_address(colours, c, row)
        y_at = row_address(colours, 3 + c, row)
        to = row_address(means, 4 * c, row + REACH)
        j = int(0)
        while j < lines - 2:
            mx = vec16()
            my = vec16()
            squares = vec16()
            product = vec16()
            x_tap = x_at - REACH_BYTES
            y_tap = y_at - REACH_BYTES
            k = int(0)
            while k < WINDOW:
                x = load_line(x_tap)
                y = load_line(y_tap)
                x_tap += FLOAT
                y_tap += FLOAT
                tx = x * taps[k]
                ty = y * taps[k]
                mx += tx
                my += ty
                squares += wp.cw_mul(tx, x) + wp.cw_mul(ty, y)
                product += wp.cw_mul(tx, y)
                k += 1
            store_line(to, mx)
            store_line(to + mean_bytes, my)
            store_line(to + wp.uint64(2) * mean_bytes, squares)
            store_line(to + wp.uint64(3) * mean_bytes, product)
            x_at += LINE
            y_at += LINE
            to += LINE
            j += 1
        c += 1
