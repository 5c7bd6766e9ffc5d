# SPDX-License-Identifier: Apache-2.0
"""MonoGS's tracking loss on a render, its gradient by the image, and Adam on the exposure.

    L = mean(w |e^a I + b - O|) + l mean(m |D - Z|)

over pixels and colours, with w the render's opacity inside the mask, and m the pixels that are opaque and
have a depth reading. Opacity weighs, but is not pulled at. Sums go part of a row -> total in a fixed order.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.optim.adam import BETA1, BETA2, EPSILON, LOG_BETA1, LOG_BETA2
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

_OPAQUE = wp.constant(0.05)
"""Transmittance below which a pixel's depth is compared."""
FOLDED = 64
"""Rows that many rows of sums are folded to before one thread adds them."""

_READING = wp.constant(0.01)
"""Depth readings closer than this are none, metres."""


@wp.func
def _sign(x: float) -> float:
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@wp.kernel
def _photometric_loss(
    offset: int,
    pieces: int,
    image: wp.array3d[float],
    transmittance: wp.array2d[float],
    colour: wp.array3d[wp.uint8],
    mask: wp.array2d[wp.uint8],
    depth: wp.array2d[float],
    exposure: wp.array[float],
    colour_weight: float,
    depth_weight: float,
    d_image: wp.array3d[float],
    sums: wp.array2d[float],
):
    item = offset + wp.tid()
    row = item / pieces
    gain = wp.exp(exposure[0])
    bias = exposure[1]
    loss = float(0.0)
    by_gain = float(0.0)
    by_bias = float(0.0)
    for column in range(item - row * pieces, colour.shape[1], pieces):
        clear = transmittance[row, column]
        w = float(0.0)
        if mask[row, column] != wp.uint8(0):
            w = colour_weight * (1.0 - clear)
        for c in range(3):
            bright = gain * image[c, row, column]
            r = bright + bias - float(colour[row, column, c]) / 255.0
            g = w * _sign(r)
            d_image[c, row, column] = g * gain
            by_gain += g * bright
            by_bias += g
            loss += w * wp.abs(r)
        d = float(0.0)
        if depth and clear < _OPAQUE:
            reading = depth[row, column]
            if reading > _READING:
                r = image[3, row, column] - reading
                d = depth_weight * _sign(r)
                loss += depth_weight * wp.abs(r)
        d_image[3, row, column] = d
    sums[item, 0] = loss
    sums[item, 1] = by_gain
    sums[item, 2] = by_bias


@wp.kernel
def _fold(sums: wp.array2d[float], folded: wp.array2d[float]):
    """Row f of ``folded``: the sum of rows f, f + F, ... of ``sums``, F being the rows of ``folded``."""
    f, k = wp.tid()
    total = wp.float64(0.0)
    for item in range(f, sums.shape[0], folded.shape[0]):
        total += wp.float64(sums[item, k])
    folded[f, k] = float(total)


@wp.kernel
def _step_exposure(
    sums: wp.array2d[float],
    rows: int,
    rate: float,
    moments: wp.array2d[float],
    steps: wp.array[wp.int32],
    exposure: wp.array[float],
    loss: wp.array[float],
):
    total = wp.vec3d()
    for row in range(rows):
        for k in range(3):
            total[k] = total[k] + wp.float64(sums[row, k])
    step = steps[0] + 1
    steps[0] = step
    t = float(step)
    c1 = 1.0 / (1.0 - wp.exp(t * LOG_BETA1))
    c2 = 1.0 / wp.sqrt(1.0 - wp.exp(t * LOG_BETA2))
    for k in range(2):
        g = float(total[k + 1])
        m = BETA1 * moments[0, k] + (1.0 - BETA1) * g
        v = BETA2 * moments[1, k] + (1.0 - BETA2) * g * g
        moments[0, k] = m
        moments[1, k] = v
        exposure[k] = exposure[k] - rate * c1 * m / (wp.sqrt(v) * c2 + EPSILON)
    loss[0] = float(total[0])


def pieces_per_row(device: Any) -> int:
    """Return the parts of a row that are summed apart: on CUDA every 32nd pixel is one, for a warp a row."""
    return 1 if wp.get_device(device).is_cpu else 32


def photometric_loss(
    image: Any,
    transmittance: Any,
    *,
    colour: Any,
    mask: Any,
    depth: Any | None,
    exposure: Any,
    weights: tuple[float, float],
    d_image: Any,
    sums: Any,
    device: Any,
) -> None:
    """Compare a render with a picture.

    Args:
        image, transmittance: [>= 4, Hp, Wp] and [Hp, Wp], the render.
        colour: [h, w, 3] uint8. mask: [h, w] uint8, 0 where colours are not compared.
        depth: [h, w] float, metres, 0 = no reading; None: not compared.
        exposure: [2] float, (a, b).
        weights: of the mean colour error and of the mean depth error.
        d_image: like ``image``; its first four channels are written, inside [h, w].
        sums: [h pieces_per_row, 3] float, written: loss, gradients by a and b, of each part of a row.
    """
    h, w = colour.shape[:2]
    pieces = pieces_per_row(device)
    launch_split(
        _photometric_loss,
        h * pieces,
        inputs=[
            pieces, image, transmittance, colour, mask, depth, exposure,
            weights[0] / (3.0 * h * w), weights[1] / (h * w), d_image,
        ],
        outputs=[sums],
        device=device,
        min_piece=16,
    )  # fmt: skip


def step_exposure(
    sums: Any,
    *,
    folded: Any,
    rate: float,
    moments: Any,
    steps: Any,
    exposure: Any,
    loss: Any,
    device: Any,
) -> None:
    """Take one Adam step on (a, b).

    Args:
        sums: of :func:`photometric_loss`. folded: [FOLDED, 3] float, scratch.
        moments, steps: [2, 2] float and [1] int, zeros at first.
        exposure: [2] float, updated.
        loss: [1] float, written.
    """
    if pieces_per_row(device) > 1:
        wp.launch(_fold, dim=folded.shape, inputs=[sums], outputs=[folded], device=device)
        sums = folded
    wp.launch(
        _step_exposure,
        dim=1,
        inputs=[sums, sums.shape[0], rate],
        outputs=[moments, steps, exposure, loss],
        device=device,
    )
