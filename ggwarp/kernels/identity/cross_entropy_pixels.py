# SPDX-License-Identifier: Apache-2.0
"""Cross-entropy of the identity image in the form for CUDA.

Work goes by the sample's tiles, in blocks of 16 x 4 pixels: a thread per pixel finds the logarithm of
its softmax sum and the gradient of its identity; then a thread per class and every ROWS-th block sums that
class's part of the classifier's gradient. Neighbouring threads hold neighbouring classes, so a pixel's
identity is read once a warp. The ROWS sums of a class are added in two steps.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.block import load16
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.sampling import first_tile

wp.set_module_options({"enable_backward": False})

IDENTITY_PLANE = wp.constant(4)

BAND_ROWS = wp.constant(4)
"""Image rows of a block."""

BANDS = wp.constant(4)
"""Blocks of a tile, one below the other."""

ROWS = 1024
"""Sums of a class that blocks share at most."""

FOLDED = 32
"""Sums that those are added to first."""

_PIXELS = wp.constant(64)
"""Of a block of the sample."""


def sampled_blocks(height: int, width: int, stride: int) -> int:
    """Return how many blocks of a padded image a sample has at most."""
    return height // int(BAND_ROWS) * -(-(width // 16) // stride)


@wp.func
def sampled_block(i: int, across: int, stride: int, phase: wp.array[wp.int32]):
    """Column, in tiles, and band of the i-th block of the sample; the column may lie beyond the image.

    Args:
        across: tiles of the image in a row.
    """
    most = (across + stride - 1) / stride
    tile = i / BANDS
    tile_y = tile / most
    column = wp.min(first_tile(tile_y, stride, phase), 1 << 20) + (tile - tile_y * most) * stride
    return column, tile_y * BANDS + i - tile * BANDS


@wp.func
def identity_at(image: wp.array3d[wp.float32], row: int, column: int) -> vec16:
    """Return the identity of a pixel of a render [20, Hp, Wp]."""
    e = vec16()
    for k in range(16):
        e[k] = image[IDENTITY_PLANE + k, row, column]
    return e


@wp.kernel
def _pixels_kernel(
    classes: int,
    stride: int,
    phase: wp.array[wp.int32],
    scale: float,
    image: wp.array3d[wp.float32],
    labels: wp.array2d[wp.int32],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    log_sums: wp.array2d[wp.float32],
    d_image: wp.array3d[wp.float32],
):
    item = wp.tid()
    block = item / _PIXELS
    k = item - block * _PIXELS
    block_column, band = sampled_block(block, image.shape[2] / 16, stride, phase)
    row = band * BAND_ROWS + k / 16
    column = block_column * 16 + k % 16
    if column >= image.shape[2]:
        return
    label = int(-1)
    if row < labels.shape[0] and column < labels.shape[1]:
        label = labels[row, column]
    d = vec16()
    if label >= 0 and label < classes:
        e = identity_at(image, row, column)
        largest = float(-1.0e30)
        total = float(0.0)
        for c in range(classes):
            z = wp.dot(load16(weights, c), e) + biases[c]
            if z > largest:
                total = total * wp.exp(largest - z) + 1.0
                largest = z
            else:
                total += wp.exp(z - largest)
        log_sum = largest + wp.log(total)
        log_sums[row, column] = log_sum
        for c in range(classes):
            w = load16(weights, c)
            d += w * wp.exp(wp.dot(w, e) + biases[c] - log_sum)
        d = (d - load16(weights, label)) * scale
    for k in range(16):
        d_image[IDENTITY_PLANE + k, row, column] = d[k]


@wp.kernel
def _classes_kernel(
    classes: int,
    stride: int,
    phase: wp.array[wp.int32],
    scale: float,
    image: wp.array3d[wp.float32],
    labels: wp.array2d[wp.int32],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    log_sums: wp.array2d[wp.float32],
    blocks: int,
    rows: int,
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
):
    item = wp.tid()
    part = item / classes
    c = item - part * classes
    d = vec16()
    db = float(0.0)
    loss = float(0.0)
    w = load16(weights, c)
    for block in range(part, blocks, rows):
        block_column, band = sampled_block(block, image.shape[2] / 16, stride, phase)
        for k in range(_PIXELS):
            row = band * BAND_ROWS + k / 16
            column = block_column * 16 + k % 16
            label = int(-1)
            if row < labels.shape[0] and column < labels.shape[1]:
                label = labels[row, column]
            if label >= 0 and label < classes:
                e = identity_at(image, row, column)
                log_p = wp.dot(w, e) + biases[c] - log_sums[row, column]
                g = wp.exp(log_p)
                if label == c:
                    g -= 1.0
                    loss -= log_p
                d += g * e
                db += g
    weight_partials[part, c] = d * scale
    other_partials[part, c] = wp.vec2(db * scale, loss)


@wp.kernel
def _fold_kernel(
    rows: int,
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
    weight_sums: wp.array2d[vec16],
    other_sums: wp.array2d[wp.vec2],
):
    f, c = wp.tid()
    d = vec16()
    other = wp.vec2()
    for row in range(f, rows, weight_sums.shape[0]):
        d += weight_partials[row, c]
        other += other_partials[row, c]
    weight_sums[f, c] = d
    other_sums[f, c] = other


def launch(
    classes: int,
    stride: int,
    phase: Any,
    scale: float,
    image: Any,
    labels: Any,
    weights: Any,
    biases: Any,
    log_sums: Any,
    *,
    d_image: Any,
    weight_partials: Any,
    other_partials: Any,
    device: Any,
) -> None:
    """Write the image gradient, and FOLDED parts of the classifier's and of the loss.

    Arguments as of ``cross_entropy`` and its workspace; ``scale`` is the weight of one pixel. The parts are
    the first FOLDED rows of the partials, whose others are scratch.
    """
    common = [classes, stride, phase, scale, image, labels, weights, biases, log_sums]
    blocks = sampled_blocks(image.shape[1], image.shape[2], stride)
    rows = min(ROWS, blocks)
    wp.launch(_pixels_kernel, dim=blocks * int(_PIXELS), inputs=common, outputs=[d_image], device=device)
    sums = [weight_partials[:FOLDED], other_partials[:FOLDED]]
    partials = [weight_partials[FOLDED:], other_partials[FOLDED:]]
    wp.launch(
        _classes_kernel,
        dim=rows * classes,
        inputs=[*common, blocks, rows],
        outputs=partials,
        device=device,
    )
    wp.launch(_fold_kernel, dim=(FOLDED, classes), inputs=[rows, *partials], outputs=sums, device=device)


def partial_rows(height: int, width: int) -> int:
    """Return the rows of partials that a padded image needs."""
    return FOLDED + min(ROWS, sampled_blocks(height, width, 1))
