# SPDX-License-Identifier: Apache-2.0
"""Sums over a warp's pixels in the composite's adjoint for CUDA: a lane's share of them.

What a warp found for 16 splats lies in shared memory by splat and pixel; a lane takes a splat and half of the
patch's pixels, or two splats and four channels of the identity: no sum crosses lanes but that of the halves.
Loops over pixels are unrolled.
"""

import warp as wp

from ggwarp.kernels.block import load4
from ggwarp.kernels.raster.composite_patches import DEPTH

wp.set_module_options({"enable_backward": False})

GROUP = 16
"""Splats whose sums a warp takes together."""

ROW_QUADS = 9
"""Quads from one splat's 32 pixels to the next's: eight, and one so that lanes read different banks."""

HALF_GROUP = GROUP // 2 * ROW_QUADS

HALF_QUADS = 17
"""From the gradients of half a patch's 16 pixels to the next half's: one apart in banks."""


@wp.func
def head_sums(
    walked: wp.tile[wp.vec4], gradients: wp.tile[wp.vec4], to_row: int, to_half: int, x0: float, y0: float
):
    """A splat's weight over half a patch, times: gradients of colour and depth; the depth's by x, y, and 1.

    Args:
        walked: weights, a quad being four pixels of a splat. gradients: a quad a pixel.
        to_row, to_half: where the splat's pixels begin, and the half's.
        x0, y0: of the half's first pixel, from the tile's centre.
    """
    by_channel = wp.vec4()
    along = float(0.0)
    down = float(0.0)
    weight = float(0.0)
    for c in range(4):
        w = walked[to_row + c]
        for i in range(4):
            g = gradients[to_half + 4 * c + i]
            by_depth = w[i] * g[DEPTH]
            by_channel[0] += w[i] * g[0]
            by_channel[1] += w[i] * g[1]
            by_channel[2] += w[i] * g[2]
            by_channel[3] += by_depth
            along += by_depth * float((c & 1) * 4 + i)
            if c > 1:
                down += by_depth
            weight += w[i]
    total = by_channel[DEPTH]
    return by_channel, wp.vec4(along + x0 * total, down + y0 * total, weight, 0.0)


@wp.func
def moments(walked: wp.tile[wp.vec4], to_row: int, x0: float, y0: float):
    """Sums of d loss / d ln alpha over half a patch, times 1, x, y, x^2; x y, y^2."""
    # Of the first and second row of pixels, times 1, x, x^2.
    first = wp.vec3()
    second = wp.vec3()
    for c in range(4):
        d = walked[to_row + c]
        for i in range(4):
            x = float((c & 1) * 4 + i)
            if c < 2:
                first[0] += d[i]
                first[1] += d[i] * x
                first[2] += d[i] * (x * x)
            else:
                second[0] += d[i]
                second[1] += d[i] * x
                second[2] += d[i] * (x * x)
    m = first + second
    mx = m[1] + x0 * m[0]
    my = second[0] + y0 * m[0]
    mxx = m[2] + x0 * (m[1] + mx)
    mxy = second[1] + x0 * second[0] + y0 * mx
    myy = second[0] + y0 * (second[0] + my)
    return wp.vec4(m[0], mx, my, mxx), wp.vec4(mxy, myy, 0.0, 0.0)


@wp.func
def code_sums(
    walked: wp.tile[wp.vec4],
    to_row: int,
    d_image: wp.array[wp.vec4],
    at: int,
    to_next_row: int,
    to_next_channel: int,
):
    """Two splats' weights times four channels of the identities' gradients, over a patch.

    Args:
        to_row: of the first splat's weights; the second's are half a group on.
        d_image: four pixels of a row a quad. at: the patch's first, in the first channel.
    """
    a = wp.vec4()
    b = wp.vec4()
    for c in range(8):
        v = walked[to_row + c]
        w = walked[to_row + HALF_GROUP + c]
        for i in range(4):
            g = load4(d_image, at + (c >> 1) * to_next_row + (c & 1) + i * to_next_channel)
            a[i] += wp.dot(g, v)
            b[i] += wp.dot(g, w)
    return a, b
