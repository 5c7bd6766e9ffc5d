# SPDX-License-Identifier: Apache-2.0
"""Pictures and renders as direct alignment compares them, and half as large.

A *view* is [h, w] vec4: red, green, blue in 0..1 and depth in metres, 0 where there is none.
"""

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _pack_picture(
    offset: int, colour: wp.array3d[wp.uint8], depth: wp.array2d[float], view: wp.array2d[wp.vec4]
):
    row = offset + wp.tid()
    for column in range(view.shape[1]):
        s = 1.0 / 255.0
        r = s * float(colour[row, column, 0])
        g = s * float(colour[row, column, 1])
        b = s * float(colour[row, column, 2])
        z = float(0.0)
        if depth:
            reading = depth[row, column]
            if reading > 0.0 and reading < 1.0e6:
                z = reading
        view[row, column] = wp.vec4(r, g, b, z)


@wp.kernel
def _pack_render(
    offset: int,
    image: wp.array3d[float],
    transmittance: wp.array2d[float],
    min_opacity: float,
    view: wp.array2d[wp.vec4],
):
    row = offset + wp.tid()
    for column in range(view.shape[1]):
        opacity = 1.0 - transmittance[row, column]
        z = float(0.0)
        if opacity >= min_opacity:
            z = image[3, row, column] / opacity
        view[row, column] = wp.vec4(image[0, row, column], image[1, row, column], image[2, row, column], z)


@wp.kernel
def _halve(offset: int, fine: wp.array2d[wp.vec4], edge: float, coarse: wp.array2d[wp.vec4]):
    row = offset + wp.tid()
    for column in range(coarse.shape[1]):
        a = fine[2 * row, 2 * column]
        b = fine[2 * row, 2 * column + 1]
        c = fine[2 * row + 1, 2 * column]
        d = fine[2 * row + 1, 2 * column + 1]
        mean = 0.25 * (a + b + c + d)
        near = wp.min(wp.min(a[3], b[3]), wp.min(c[3], d[3]))
        far = wp.max(wp.max(a[3], b[3]), wp.max(c[3], d[3]))
        # Depth does not average across an edge or a hole.
        if near <= 0.0 or far - near > edge * near:
            mean[3] = 0.0
        coarse[row, column] = mean


def pack_picture(colour: Any, depth: Any | None, *, view: Any, device: Any) -> None:
    """Make a view of a camera's picture.

    Args:
        colour: [h, w, 3] uint8.
        depth: [h, w] float, metres; no reading where 0, NaN or infinite. None: none anywhere.
        view: [h, w] vec4, written.
    """
    launch_split(
        _pack_picture, view.shape[0], inputs=[colour, depth], outputs=[view], device=device, min_piece=16
    )


def pack_render(image: Any, transmittance: Any, *, min_opacity: float, view: Any, device: Any) -> None:
    """Make a view of a render.

    Args:
        image: [>= 4, Hp, Wp] colour and expected depth.
        transmittance: [Hp, Wp].
        min_opacity: less opaque pixels have no depth, so that nothing is compared there.
        view: [h, w] vec4, written.
    """
    launch_split(
        _pack_render,
        view.shape[0],
        inputs=[image, transmittance, min_opacity],
        outputs=[view],
        device=device,
        min_piece=16,
    )


def halve(fine: Any, *, edge: float, coarse: Any, device: Any) -> None:
    """Average 2 x 2 pixels; no depth where they differ by more than the share ``edge``.

    Args:
        fine: [h, w] vec4.
        coarse: [h // 2, w // 2] vec4, written.
    """
    launch_split(_halve, coarse.shape[0], inputs=[fine, edge], outputs=[coarse], device=device, min_piece=16)
