# SPDX-License-Identifier: Apache-2.0
"""The most probable class of each pixel of an identity image, or of each Gaussian."""

from typing import Any

import warp as wp

from ggwarp.kernels.identity.cross_entropy import exp16, runs_by_rows
from ggwarp.kernels.identity.cross_entropy_pixels import IDENTITY_PLANE, identity_at
from ggwarp.kernels.math import vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.func
def _best_class(e: vec16, classes: int, weights: wp.array[vec16], biases: wp.array[wp.float32]):
    """Return (class, probability); the first of equal classes; (-1, 0) when no logit is finite."""
    best = int(-1)
    largest = float(-1.0e30)
    for c in range(classes):
        z = wp.dot(weights[c], e) + biases[c]
        if z > largest:
            largest = z
            best = c
    total = float(0.0)
    for c in range(classes):
        total += wp.exp(wp.dot(weights[c], e) + biases[c] - largest)
    probability = float(0.0)
    if best >= 0:
        probability = 1.0 / total
    return best, probability


@wp.func
def _logits(
    image: wp.array3d[vec16], row: int, block: int, c: int, weights: wp.array[vec16], biases: wp.array[float]
) -> vec16:
    w = weights[c]
    z = vec16(biases[c])
    k = int(0)
    while k < 16:
        z += w[k] * image[IDENTITY_PLANE + k, row, block]
        k += 1
    return z


@wp.kernel
def _rows_kernel(
    offset: int,
    classes: int,
    image: wp.array3d[vec16],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    labels: wp.array2d[wp.int32],
    probabilities: wp.array2d[wp.float32],
):
    """CPU form: 16 pixels of a row at a time, the arg max by arithmetic."""
    row = offset + wp.tid()
    one = vec16(1.0)
    for block in range(image.shape[2]):
        largest = vec16(-1.0e30)
        best = vec16(-1.0)
        for c in range(classes):
            z = _logits(image, row, block, c, weights, biases)
            # 1 where z is larger, 0 elsewhere.
            larger = wp.min(wp.max((z - largest) * 1.0e30, vec16()), one)
            best += wp.cw_mul(larger, vec16(float(c)) - best)
            largest = wp.max(largest, z)
        total = vec16()
        for c in range(classes):
            total += exp16(_logits(image, row, block, c, weights, biases) - largest)
        for lane in range(wp.min(16, labels.shape[1] - 16 * block)):
            label = int(-1)
            probability = float(0.0)
            # False for NaN.
            if best[lane] >= 0.0 and total[lane] >= 1.0:
                label = int(best[lane])
                probability = 1.0 / total[lane]
            labels[row, 16 * block + lane] = label
            probabilities[row, 16 * block + lane] = probability


@wp.kernel
def _pixels_kernel(
    classes: int,
    image: wp.array3d[wp.float32],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    labels: wp.array2d[wp.int32],
    probabilities: wp.array2d[wp.float32],
):
    item = wp.tid()
    row = item / labels.shape[1]
    column = item - row * labels.shape[1]
    e = identity_at(image, row, column)
    label, probability = _best_class(e, classes, weights, biases)
    labels[row, column] = label
    probabilities[row, column] = probability


@wp.kernel
def _gaussians_kernel(
    offset: int,
    classes: int,
    identities: wp.array[vec16],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    labels: wp.array[wp.int32],
    probabilities: wp.array[wp.float32],
):
    i = offset + wp.tid()
    label, probability = _best_class(identities[i], classes, weights, biases)
    labels[i] = label
    probabilities[i] = probability


def classify_pixels(
    image: Any, *, weights: Any, biases: Any, classes: int, labels: Any, probabilities: Any, device: Any
) -> None:
    """Write each pixel's most probable class and its softmax probability.

    Args:
        image: [20, Hp, Wp] render, contiguous; planes 4-19 are the identity.
        weights: [>= classes] vec16; biases: [>= classes] float.
        classes: classes in use.
        labels: [H, W] int, written; -1 where no logit is finite.
        probabilities: [H, W] float, written.
        device: a Warp device.
    """
    outputs = [labels, probabilities]
    if runs_by_rows(device):
        shape = (*image.shape[:2], image.shape[2] // 16)
        blocks = wp.array(ptr=image.ptr, dtype=vec16, shape=shape, device=image.device)
        launch_split(
            _rows_kernel,
            labels.shape[0],
            inputs=[classes, blocks, weights, biases],
            outputs=outputs,
            device=device,
            min_piece=8,
        )
    else:
        wp.launch(
            _pixels_kernel,
            dim=labels.shape[0] * labels.shape[1],
            inputs=[classes, image, weights, biases],
            outputs=outputs,
            device=device,
        )


def classify_gaussians(
    identities: Any, *, weights: Any, biases: Any, classes: int, labels: Any, probabilities: Any, device: Any
) -> None:
    """Write each Gaussian's most probable class and its softmax probability.

    Args:
        identities: [>= n] vec16.
        weights, biases, classes: as of :func:`classify_pixels`.
        labels: [n] int, written; -1 where no logit is finite.
        probabilities: [n] float, written.
        device: a Warp device.
    """
    launch_split(
        _gaussians_kernel,
        labels.shape[0],
        inputs=[classes, identities, weights, biases],
        outputs=[labels, probabilities],
        device=device,
    )
