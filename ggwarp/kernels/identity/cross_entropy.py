# SPDX-License-Identifier: Apache-2.0
"""Identity classifier on the rendered identity image: cross-entropy and its adjoint (GG-SLAM eq. 8).

z = W e + b per pixel, L_obj = mean CE(z, y) / log(classes), the mean over all H W pixels; ignored
pixels (label outside [0, classes)) add nothing. Sums over pixels are kept in parts, on a CPU per band of 4
image rows, then added one by one: the result does not depend on threads.

Two forms. By bands (CPU, here): an item per band, 16 pixels at a time as the lanes of a vec16. By
pixels (CUDA): :mod:`ggwarp.kernels.identity.cross_entropy_pixels`.
"""

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.identity import cross_entropy_pixels
from ggwarp.kernels.identity.cross_entropy_pixels import BAND_ROWS, BANDS, IDENTITY_PLANE
from ggwarp.kernels.losses.rgbd import OBJECT
from ggwarp.kernels.math import VECTOR_OPTIONS, vec16
from ggwarp.kernels.raster.composite_patches import transpose_quads
from ggwarp.kernels.raster.sampling import Sample, in_sample
from ggwarp.runtime.launch import launch_split

wp.set_module_options(VECTOR_OPTIONS)

mat16 = wp.types.matrix((16, 16), wp.float32)

_LINE = wp.constant(wp.uint64(64))
"""Bytes of a vec16."""


@dataclass(frozen=True)
class IdentityWorkspace:
    """Scratch of the cross-entropy for images of [Hp, Wp] and up to ``capacity`` classes.

    Attributes:
        logits, bias_sums: [Hp / 4, capacity] vec16, CPU only.
        blocks: [Hp / 4, 32] vec16, CPU only.
        log_sums: [Hp, Wp] float, CUDA only.
        weight_partials: [R, capacity] vec16, parts of the gradient of W: R = Hp / 4, a part a band, on a CPU,
            ``cross_entropy_pixels.partial_rows`` on CUDA.
        other_partials: [R, capacity] vec2, of b's gradient and of the loss.
        class_losses: [capacity] float.
    """

    logits: Any
    bias_sums: Any
    blocks: Any
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
def _clear_line(row: int, block: int, d_image: wp.array3d[vec16]):
    k = int(0)
    while k < 16:
        d_image[IDENTITY_PLANE + k, row, block] = vec16()
        k += 1


@wp.kernel
def _bands_kernel(
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
    blocks: wp.array2d[vec16],
    bias_sums: wp.array2d[vec16],
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
    d_image: wp.array3d[vec16],
):
    """Cross-entropy of a band's sample; ``*_lanes`` are float views of the vec16 arrays."""
    band = offset + wp.tid()
    # Strides that are known make short addresses.
    weight_lines = wp.array(ptr=weights.ptr, shape=(classes,), dtype=vec16)
    begin = wp.uint64(band * logits.shape[1]) * _LINE
    lines = wp.array(ptr=logits.ptr + begin, shape=(classes,), dtype=vec16)
    bias_lines = wp.array(ptr=bias_sums.ptr + begin, shape=(classes,), dtype=vec16)
    sums = wp.array(ptr=weight_partials.ptr + begin, shape=(classes,), dtype=vec16)
    at = blocks.ptr + wp.uint64(band * 32) * _LINE
    channels = wp.array(ptr=at, shape=(16,), dtype=vec16)
    channel_quads = wp.array(ptr=at, shape=(64,), dtype=wp.vec4)
    by_channel = wp.array(ptr=at, shape=(1,), dtype=mat16)
    pixel_quads = wp.array(ptr=at + wp.uint64(16) * _LINE, shape=(64,), dtype=wp.vec4)
    by_pixel = wp.array(ptr=at + wp.uint64(16) * _LINE, shape=(1,), dtype=mat16)
    for c in range(classes):
        sums[c] = vec16()
        bias_lines[c] = vec16()
    loss = float(0.0)
    product = float(1.0)
    rows = BAND_ROWS * image.shape[2]
    for item in range(rows):
        block = item / BAND_ROWS
        row = band * BAND_ROWS + item - block * BAND_ROWS
        if not in_sample(block, band / BANDS, stride, phase):
            continue
        lanes = wp.min(16, labels.shape[1] - 16 * block)
        if row >= labels.shape[0]:
            _clear_line(row, block, d_image)
            continue
        k = int(0)
        while k < 16:
            channels[k] = image[IDENTITY_PLANE + k, row, block]
            k += 1
        e = by_channel[0]
        largest = vec16(-1.0e30)
        for c in range(classes):
            w = weight_lines[c]
            z = vec16(biases[c])
            for i in range(16):
                z += w[i] * e[i]
            lines[c] = z
            largest = wp.max(largest, z)

        active = vec16()
        for i in range(lanes):
            label = labels[row, 16 * block + i]
            if label >= 0 and label < classes:
                active[i] = scale
                loss += largest[i] - logit_lanes[band, label, i]

        total = vec16()
        for c in range(classes):
            p = exp16(lines[c] - largest)
            lines[c] = p
            total += p

        # p - y, times the sum; the log of many sums is taken as the log of their product.
        for i in range(lanes):
            label = labels[row, 16 * block + i]
            if label >= 0 and label < classes:
                logit_lanes[band, label, i] = logit_lanes[band, label, i] - total[i]
                product *= total[i]
                if product > 1.0e30:
                    loss += wp.log(product)
                    product = 1.0

        factor = wp.cw_div(active, total)
        quad = int(0)
        while quad < 16:
            transpose_quads(
                channel_quads, 16 * (quad >> 2) + (quad & 3), pixel_quads, 16 * (quad & 3) + (quad >> 2), 4
            )
            quad += 1
        turned = by_pixel[0]
        for c in range(classes):
            g = wp.cw_mul(lines[c], factor)
            lines[c] = g
            s = sums[c]
            k = int(0)
            while k < 16:  # not unrolled: it takes as long, and a third less to compile
                s += g[k] * turned[k]
                k += 1
            sums[c] = s
            bias_lines[c] += g

        d = mat16()
        for c in range(classes):
            g = lines[c]
            w = weight_lines[c]
            for i in range(16):
                d[i] += w[i] * g
        by_channel[0] = d
        k = int(0)
        while k < 16:
            d_image[IDENTITY_PLANE + k, row, block] = channels[k]
            k += 1
    loss += wp.log(product)
    for c in range(classes):
        other_partials[band, c] = wp.vec2(wp.dot(bias_lines[c], vec16(1.0)), wp.where(c == 0, loss, 0.0))


@wp.kernel
def _fold_kernel(
    rows: int,
    weight_partials: wp.array2d[vec16],
    other_partials: wp.array2d[wp.vec2],
    d_weights: wp.array[vec16],
    d_biases: wp.array[wp.float32],
    class_losses: wp.array[wp.float32],
):
    c = wp.tid()
    d = vec16()
    other = wp.vec2()
    for row in range(rows):
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
    sample: Sample | None = None,
    weight: float = 0.1,
    device: Any,
) -> None:
    """Evaluate L_obj of a rendered identity image and write its adjoint.

    Args:
        image: [20, Hp, Wp] render, contiguous; planes 4-19 are the identity.
        labels: [H, W] int class of each pixel; ignored where outside [0, classes).
        weights: [>= classes] vec16, rows of W; biases: [>= classes] float, b.
        classes: classes in use; with a single one the loss is zero.
        d_image: [20, Hp, Wp] contiguous; planes 4-19 are written in the sample, zeros in the padding.
        d_weights, d_biases: like ``weights`` and ``biases``; the first ``classes`` are written.
        losses: ``losses[OBJECT]`` becomes the unweighted L_obj.
        workspace: scratch of this [Hp, Wp], with room for ``classes``.
        sample: only tiles in it are evaluated, and count ``sample.stride`` times; over random phases the
            gradient's mean is that of all pixels. None: all pixels.
        weight: l_obj.
        device: a Warp device.

    Raises:
        ValueError: ``classes`` is not in 1..capacity.
    """
    height, width = labels.shape
    capacity = min(workspace.weight_partials.shape[1], weights.shape[0])
    if not 1 <= classes <= capacity:
        raise ValueError(f"identity classes: {classes}, but there is room for 1 to {capacity}")
    stride, phase = (1, None) if sample is None else (sample.stride, sample.phase)
    unit = stride / (height * width * math.log(classes)) if classes > 1 else 0.0
    partials = [workspace.weight_partials, workspace.other_partials]
    rows = workspace.weight_partials.shape[0]
    head = [classes, stride, phase, weight * unit]
    if runs_by_rows(device):
        blocks = image.shape[2] // 16
        logits = workspace.logits
        launch_split(
            _bands_kernel,
            image.shape[1] // int(BAND_ROWS),
            inputs=[
                *(*head, _view(image, vec16, (*image.shape[:2], blocks)), labels, weights, biases),
                *(logits, _view(logits, wp.float32, (*logits.shape, 16))),
                *(workspace.blocks, workspace.bias_sums),
            ],
            outputs=[*partials, _view(d_image, vec16, (*d_image.shape[:2], blocks))],
            device=device,
            min_piece=4,
        )
    else:
        cross_entropy_pixels.launch(
            *(*head, image, labels, weights, biases, workspace.log_sums),
            d_image=d_image,
            weight_partials=workspace.weight_partials,
            other_partials=workspace.other_partials,
            device=device,
        )
        rows = cross_entropy_pixels.FOLDED
    wp.launch(
        _fold_kernel,
        dim=classes,
        inputs=[rows, *partials],
        outputs=[d_weights, d_biases, workspace.class_losses],
        device=device,
    )
    wp.launch(_loss_kernel, dim=1, inputs=[classes, unit, workspace.class_losses, losses], device=device)
