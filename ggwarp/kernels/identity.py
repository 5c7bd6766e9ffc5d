# SPDX-License-Identifier: Apache-2.0
"""Identity classifier on the rendered identity image: cross-entropy and its adjoint (GG-SLAM eq. 8).

z = W e + b per pixel, L_obj = mean CE(z, y) / log(classes), the mean over all H W pixels; ignored
pixels (label outside [0, classes)) add nothing. Sums over pixels are kept per image row, then
added row by row: the result does not depend on threads.

Two forms. By rows (CPU, here): a thread per row, 16 pixels at a time as the lanes of a vec16. By
pixels (CUDA): :mod:`ggwarp.kernels.identity_pixels`.
"""

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels import identity_pixels
from ggwarp.kernels.identity_pixels import IDENTITY_PLANE
from ggwarp.kernels.launch import launch_split
from ggwarp.kernels.loss import OBJECT
from ggwarp.kernels.math import vec16

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class IdentityWorkspace:
    """Scratch of the cross-entropy for images of [Hp, Wp] and up to ``capacity`` classes.

    Attributes:
        logits, bias_sums: [Hp, capacity] vec16, CPU only.
        pixels: [Hp, 16] vec16, CPU only.
        log_sums: [Hp, Wp] float, CUDA only.
        weight_partials: [Hp, capacity] vec16, each row's part of the gradient of W.
        other_partials: [Hp, capacity] vec2, of b's gradient and of the loss.
        class_losses: [capacity] float.
    """

    logits: Any
    bias_sums: Any
    pixels: Any
    log_sums: Any
    weight_partials: Any
    other_partials: Any
    class_losses: Any


@wp.func
def exp16(x: vec16) -> vec16:
    """exp(x) for x <= 0, absolute error < 3e-6: a polynomial of x / 32, squared five times."""
    y = wp.max(x, vec16(-20.0)) * (1.0 / 32.0)
    p = y * (1.0 / 24.0) + vec16(1.0 / 6.0)
    p = wp.cw_mul(p, y) + vec16(0.5)
    p = wp.cw_mul(p, y) + vec16(1.0)
    p = wp.cw_mul(p, y) + vec16(1.0)
    p = wp.cw_mul(p, p)
    p = wp.cw_mul(p, p)
    p = wp.cw_mul(p, p)
    p = wp.cw_mul(p, p)
    return wp.cw_mul(p, p)


@wp.func
def _clear_row(row: int, d_image: wp.array3d[vec16]):
    for block in range(d_image.shape[2]):
        for k in range(16):
            d_image[IDENTITY_PLANE + k, row, block] = vec16()


@wp.kernel
def _rows_kernel(
    offset: int,
    classes: int,
    stride: int,
    phase: wp.array[wp.int32],
    scale: float,
    image: wp.array3d[vec16],
    labels: wp.array2d[wp.int32],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    logits: wp.array2d[vec16],
    logit_lanes: wp.array3d[wp.float32],
    pixels: wp.array2d[vec16],
    pixel_lanes: wp.array3d[wp.float32],
    image_lanes: wp.array3d[wp.float32],
    bias_sums: wp.array2d[vec16],
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
    d_image: wp.array3d[vec16],
):
    """Cross-entropy of one image row; ``*_lanes`` are float views of the vec16 arrays."""
    row = offset + wp.tid()
    if row >= labels.shape[0] or row % stride != phase[0]:
        _clear_row(row, d_image)
        return
    for c in range(classes):
        weight_partials[row, c] = vec16()
        bias_sums[row, c] = vec16()
    loss = float(0.0)
    product = float(1.0)
    for block in range(image.shape[2]):
        largest = vec16(-1.0e30)
        for c in range(classes):
            w = weights[c]
            z = vec16(biases[c])
            for k in range(16):
                z += w[k] * image[IDENTITY_PLANE + k, row, block]
            logits[row, c] = z
            largest = wp.max(largest, z)

        lanes = wp.min(16, labels.shape[1] - 16 * block)
        active = vec16()
        for i in range(lanes):
            label = labels[row, 16 * block + i]
            if label >= 0 and label < classes:
                active[i] = scale
                loss += largest[i] - logit_lanes[row, label, i]

        total = vec16()
        for c in range(classes):
            p = exp16(logits[row, c] - largest)
            logits[row, c] = p
            total += p

        # p - y, times the sum; the log of many sums is taken as the log of their product.
        for i in range(lanes):
            label = labels[row, 16 * block + i]
            if label >= 0 and label < classes:
                logit_lanes[row, label, i] = logit_lanes[row, label, i] - total[i]
                product *= total[i]
                if product > 1.0e30:
                    loss += wp.log(product)
                    product = 1.0
            for k in range(16):
                pixel_lanes[row, i, k] = image_lanes[IDENTITY_PLANE + k, row, 16 * block + i]
        for i in range(lanes, 16):
            pixels[row, i] = vec16()

        factor = wp.cw_div(active, total)
        for c in range(classes):
            g = wp.cw_mul(logits[row, c], factor)
            logits[row, c] = g
            s = weight_partials[row, c]
            for i in range(16):
                s += g[i] * pixels[row, i]
            weight_partials[row, c] = s
            bias_sums[row, c] += g

        for quarter in range(4):
            k = 4 * quarter
            d0 = vec16()
            d1 = vec16()
            d2 = vec16()
            d3 = vec16()
            for c in range(classes):
                g = logits[row, c]
                w = weights[c]
                d0 += w[k] * g
                d1 += w[k + 1] * g
                d2 += w[k + 2] * g
                d3 += w[k + 3] * g
            d_image[IDENTITY_PLANE + k, row, block] = d0
            d_image[IDENTITY_PLANE + 1 + k, row, block] = d1
            d_image[IDENTITY_PLANE + 2 + k, row, block] = d2
            d_image[IDENTITY_PLANE + 3 + k, row, block] = d3
    loss += wp.log(product)
    for c in range(classes):
        other_partials[row, c] = wp.vec2(wp.dot(bias_sums[row, c], vec16(1.0)), wp.where(c == 0, loss, 0.0))


@wp.kernel
def _fold_kernel(
    height: int,
    stride: int,
    phase: wp.array[wp.int32],
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
    d_weights: wp.array[vec16],
    d_biases: wp.array[wp.float32],
    class_losses: wp.array[wp.float32],
):
    c = wp.tid()
    d = vec16()
    other = wp.vec2()
    for row in range(phase[0], height, stride):
        d += weight_partials[row, c]
        other += other_partials[row, c]
    d_weights[c] = d
    d_biases[c] = other[0]
    class_losses[c] = other[1]


@wp.kernel
def _loss_kernel(
    classes: int, scale: float, class_losses: wp.array[wp.float32], losses: wp.array[wp.float32]
):
    total = float(0.0)
    for c in range(classes):
        total += class_losses[c]
    losses[OBJECT] = total * scale


def runs_by_rows(device: Any) -> bool:
    """Return whether the cross-entropy takes its CPU form."""
    return wp.get_device(device).is_cpu


def _view(array: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
    view._ref = array
    return view


def cross_entropy(
    image: Any,
    labels: Any,
    *,
    weights: Any,
    biases: Any,
    classes: int,
    d_image: Any,
    d_weights: Any,
    d_biases: Any,
    losses: Any,
    workspace: IdentityWorkspace,
    phase: Any,
    weight: float = 0.1,
    stride: int = 1,
    device: Any,
) -> None:
    """Evaluate L_obj of a rendered identity image and write its adjoint.

    Args:
        image: [20, Hp, Wp] render, contiguous; planes 4-19 are the identity.
        labels: [H, W] int class of each pixel; ignored where outside [0, classes).
        weights: [>= classes] vec16, rows of W; biases: [>= classes] float, b.
        classes: classes in use; with a single one the loss is zero.
        d_image: [20, Hp, Wp] contiguous; planes 4-19 are written, zeros in the padding.
        d_weights, d_biases: like ``weights`` and ``biases``; the first ``classes`` are written.
        losses: ``losses[OBJECT]`` becomes the unweighted L_obj.
        workspace: scratch of this [Hp, Wp], with room for ``classes``.
        phase: [1] int in 0..stride - 1.
        weight: l_obj.
        stride: only rows with row % stride == phase are evaluated, and count ``stride`` times; over
            random phases the gradient's mean is that of all rows.
        device: a Warp device.

    Raises:
        ValueError: ``classes`` is not in 1..capacity.
    """
    height, width = labels.shape
    capacity = min(workspace.weight_partials.shape[1], weights.shape[0])
    if not 1 <= classes <= capacity:
        raise ValueError(f"identity classes: {classes}, but there is room for 1 to {capacity}")
    unit = stride / (height * width * math.log(classes)) if classes > 1 else 0.0
    partials = [workspace.weight_partials, workspace.other_partials]
    head = [classes, stride, phase, weight * unit]
    if runs_by_rows(device):
        blocks = image.shape[2] // 16
        logits, pixels = workspace.logits, workspace.pixels
        launch_split(
            _rows_kernel,
            image.shape[1],
            inputs=[
                *(*head, _view(image, vec16, (*image.shape[:2], blocks)), labels, weights, biases),
                *(logits, _view(logits, wp.float32, (*logits.shape, 16))),
                *(pixels, _view(pixels, wp.float32, (*pixels.shape, 16)), image, workspace.bias_sums),
            ],
            outputs=[*partials, _view(d_image, vec16, (*d_image.shape[:2], blocks))],
            device=device,
            min_piece=8,
        )
    else:
        identity_pixels.launch(
            *(*head, image, labels, weights, biases, workspace.log_sums),
            d_image=d_image,
            weight_partials=workspace.weight_partials,
            other_partials=workspace.other_partials,
            device=device,
        )
    wp.launch(
        _fold_kernel,
        dim=classes,
        inputs=[height, stride, phase, *partials],
        outputs=[d_weights, d_biases, workspace.class_losses],
        device=device,
    )
    wp.launch(_loss_kernel, dim=1, inputs=[classes, unit, workspace.class_losses, losses], device=device)
