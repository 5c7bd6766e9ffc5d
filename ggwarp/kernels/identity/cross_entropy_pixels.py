# SPDX-License-Identifier: Apache-2.0
"""Cross-entropy of the identity image in the form for CUDA.

A thread per pixel finds the logarithm of its softmax sum and the gradient of its identity; then
a thread per (band, class) walks the band and sums that class's part of the classifier's gradient.
Neighbouring threads hold neighbouring classes, so a pixel's identity is read once a warp.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.sampling import BAND_ROWS, first_band, in_sample

wp.set_module_options({"enable_backward": False})

IDENTITY_PLANE = wp.constant(4)


@wp.func
def identity_at(image: wp.array3d[wp.float32], row: int, column: int) -> vec16:
    """Return the identity of a pixel of a render [20, Hp, Wp]."""
    e = vec16()
    for k in range(16):
        e[k] = image[IDENTITY_PLANE + k, row, column]
    return e


@wp.kernel
def _pixels_kernel(
    width: int,
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
    row = item / width
    column = item - row * width
    if not in_sample(row / BAND_ROWS, first_band(column / 16, 0, stride, phase), stride):
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
            z = wp.dot(weights[c], e) + biases[c]
            if z > largest:
                total = total * wp.exp(largest - z) + 1.0
                largest = z
            else:
                total += wp.exp(z - largest)
        log_sum = largest + wp.log(total)
        log_sums[row, column] = log_sum
        for c in range(classes):
            w = weights[c]
            d += w * wp.exp(wp.dot(w, e) + biases[c] - log_sum)
        d = (d - weights[label]) * scale
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
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
):
    item = wp.tid()
    band = item / classes
    c = item % classes
    d = vec16()
    db = float(0.0)
    loss = float(0.0)
    w = weights[c]
    for block in range((labels.shape[1] + 15) / 16):
        if not in_sample(band, first_band(block, 0, stride, phase), stride):
            continue
        for k in range(16 * BAND_ROWS):
            row = band * BAND_ROWS + k / 16
            column = block * 16 + k % 16
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
    weight_partials[band, c] = d * scale
    other_partials[band, c] = wp.vec2(db * scale, loss)


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
    """Write the image gradient, and each band's parts of the classifier's and of the loss.

    Arguments as of ``cross_entropy`` and its workspace; ``scale`` is the weight of one pixel.
    """
    common = [classes, stride, phase, scale, image, labels, weights, biases, log_sums]
    padded_width = image.shape[2]
    wp.launch(
        _pixels_kernel,
        dim=image.shape[1] * padded_width,
        inputs=[padded_width, *common],
        outputs=[d_image],
        device=device,
    )
    wp.launch(
        _classes_kernel,
        dim=image.shape[1] // int(BAND_ROWS) * classes,
        inputs=common,
        outputs=[weight_partials, other_partials],
        device=device,
    )
