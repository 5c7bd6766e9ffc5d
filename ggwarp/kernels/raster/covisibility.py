# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians a view sees (MonoGS): those that the light reaches before half of it is taken."""

from __future__ import annotations

import warp as wp

from ggwarp.kernels.raster.project import Splats
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

SLACK = wp.constant(0.01)
"""Share of the depth by which a splat may lie behind the median splat: neighbours on one surface."""


@wp.kernel
def _flag_seen(
    offset: int,
    tile_rects: wp.array[wp.vec4i],
    means2d: wp.array[wp.vec2],
    slopes: wp.array[wp.vec2],
    depths: wp.array[float],
    median_depth: wp.array2d[float],
    width: int,
    height: int,
    flags: wp.array[wp.uint8],
):
    i = offset + wp.tid()
    flags[i] = wp.uint8(0)
    rect = tile_rects[i]
    if rect[0] >= rect[2]:
        return
    uv = means2d[i]
    # The pixel of the image nearest to the mean.
    x = int(wp.clamp(wp.round(uv[0]), 0.0, float(width - 1)))
    y = int(wp.clamp(wp.round(uv[1]), 0.0, float(height - 1)))
    median = median_depth[y, x]
    depth = depths[i] + wp.dot(slopes[i], wp.vec2(float(x), float(y)) - uv)
    if median == 0.0 or depth <= (1.0 + SLACK) * median:
        flags[i] = wp.uint8(1)


def flag_seen(
    splats: Splats,
    median_depth: wp.array,
    *,
    width: int,
    height: int,
    count: int,
    flags: wp.array,
) -> None:
    """Flag the Gaussians that a view sees.

    A Gaussian is seen when less than half of the light is taken in front of it, at the pixel nearest to its
    mean: it lies no deeper than the splat at which the transmittance falls under one half.

    Args:
        splats: the view's projection.
        median_depth: [Hp, Wp] metres, of the view's composite; 0 where half of the light passes.
        width, height: image size, pixels.
        count: Gaussians in use.
        flags: [>= count] uint8 out: 1 = seen.
    """
    launch_split(
        _flag_seen,
        count,
        inputs=[
            splats.tile_rects,
            splats.means2d,
            splats.slopes,
            splats.depths,
            median_depth,
            width,
            height,
        ],
        outputs=[flags],
        device=flags.device,
    )
