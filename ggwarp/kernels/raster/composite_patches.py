# SPDX-License-Identifier: Apache-2.0
"""Pieces of compositing, most of them of its CPU form: a tile as 16 patches of 4 x 4 pixels.

A patch is one 16-wide vector, which LLVM turns into one AVX-512 register (or two of AVX2, four of
NEON). A splat touches only the patches that its ellipse's bounding box touches; compared with rows
of 16 pixels that is a third fewer.

Habits that make LLVM write what one would by hand, at up to five times the speed of the obvious code:
loops over patches and splats run to run-time numbers (Warp unrolls loops over constants); local
arrays are seen through arrays built over aligned addresses (strides become constants and no load
straddles two cache lines); sums that a loop carries are stored as whole vectors when it ends. And one
kernel a module, which calls a function once: LLVM always inlines that.
"""

import warp as wp

from ggwarp.kernels.math import vec16

wp.set_module_options({"enable_backward": False})

TILES = 4
"""Tiles in a task: its scratch is cleared once."""

vec8 = wp.types.vector(8, wp.float32)

DEPTH = wp.constant(3)
"""The channel of depth."""

ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
OPACITY_MIN = wp.constant(1.0e-30)
LINE = wp.constant(wp.uint64(64))
"""Bytes of a cache line, and of a vec16."""

_LANE_X = wp.constant(vec16(0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0))
_LANE_Y = wp.constant(vec16(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0))


@wp.func
def exp_in_range(x: vec16) -> vec16:
    """exp on [-5.6, 0.05], relative error 2e-6: a minimax polynomial of exp(x / 8), to the eighth.

    Outside it is finite, infinite or NaN, and the caller discards it.
    """
    r = x * 1.7897336018226556e-07 + vec16(9.718701615516684e-06)
    r = wp.cw_mul(r, x) + vec16(0.0003242176520565299)
    r = wp.cw_mul(r, x) + vec16(0.007810792176278761)
    r = wp.cw_mul(r, x) + vec16(0.1249992006078217)
    r = wp.cw_mul(r, x) + vec16(0.9999999600539997)
    r = wp.cw_mul(r, r)
    r = wp.cw_mul(r, r)
    return wp.cw_mul(r, r)


@wp.func
def patch_x(patch: int) -> vec16:
    """Pixel columns of a patch's lanes, from the tile's left edge."""
    return _LANE_X + vec16(float((patch & 3) * 4))


@wp.func
def patch_y(patch: int) -> vec16:
    return _LANE_Y + vec16(float((patch >> 2) * 4))


@wp.func
def aligned(address: wp.uint64) -> wp.uint64:
    """The next cache line."""
    return (address + wp.uint64(63)) & ~wp.uint64(63)


@wp.func
def transpose_quads(source: wp.array[wp.vec4], first: int, out: wp.array[wp.vec4], to: int, stride: int):
    """Turn four pixels of four channels, 4 quads apart, into four channels of four pixels."""
    a = source[first]
    b = source[first + 4]
    c = source[first + 8]
    d = source[first + 12]
    for i in range(4):
        out[to + i * stride] = wp.vec4(a[i], b[i], c[i], d[i])


@wp.func
def any_at_least(v: vec16, bound: float) -> bool:
    count = int(0)
    for j in range(16):
        count += wp.where(v[j] >= bound, 1, 0)
    return count > 0


@wp.func
def on_tile(row: vec16, tile_x: int, tile_y: int) -> vec16:
    """A row of :class:`ggwarp.kernels.raster.project.Splats` as the loops over patches want it.

    In place of the conic come the factors of dx^2, dx dy, dy^2 in ln alpha; the centre is from the tile's
    corner.
    """
    s = row
    s[0] = -0.5 * row[0]
    s[1] = -row[1]
    s[2] = -0.5 * row[2]
    s[4] = row[4] - float(tile_x * 16)
    s[5] = row[5] - float(tile_y * 16)
    return s


@wp.func
def log_alpha(s: vec16, dx: vec16, dy: vec16) -> vec16:
    """ln alpha before the clamp.

    Here and below one term is added at a time: multiply-adds can form in one way only, so that kernels
    with identities and without agree to the bit.
    """
    return vec16(s[14]) + wp.cw_mul(dy, dy * s[2]) + wp.cw_mul(dx, dx * s[0]) + wp.cw_mul(dx, dy * s[1])


@wp.func
def depth_at(s: vec16, dx: vec16, dy: vec16) -> vec16:
    return vec16(s[11]) + dx * s[6] + dy * s[7]


@wp.func
def _span(centre: float, extent: float):
    """First and last-plus-one of the tile's four patches that [centre - extent, centre + extent] meets."""
    first = int(wp.clamp((centre - extent) * 0.25 + 0.2475, 0.0, 4.0))
    last = int(wp.clamp((centre + extent) * 0.25 + 1.0, 0.0, 4.0))
    return first, last


@wp.func
def patch_rect(s: vec16) -> wp.vec4i:
    """Patches (x0, y0, x1, y1), half open, where alpha can reach 1/255."""
    # False for NaN, which has no place in the lists.
    if not (s[12] + s[13] + wp.abs(s[4]) + wp.abs(s[5]) < 1.0e9):
        return wp.vec4i(0, 0, 0, 0)
    x0, x1 = _span(s[4], s[12])
    y0, y1 = _span(s[5], s[13])
    return wp.vec4i(x0, y0, x1, y1)


@wp.func
def gather_splats(
    size: int,
    slots: wp.array[int],
    begin: int,
    slot_gaussians: wp.array[int],
    rows: wp.array[vec16],
    gaussians: wp.array[int],
    splats: wp.array[vec16],
):
    """Fetch ``size`` splats. Loops of few instructions: so many of the waits for memory overlap."""
    k = int(0)
    while k < size:
        gaussians[k] = slot_gaussians[slots[begin + k]]
        k += 1
    k = int(0)
    while k < size:
        splats[k] = rows[gaussians[k]]
        k += 1


@wp.func
def gather_codes(size: int, gaussians: wp.array[int], identities: wp.array[vec16], codes: wp.array[vec16]):
    """Fetch the identities of ``size`` splats."""
    k = int(0)
    while k < size:
        codes[k] = identities[gaussians[k]]
        k += 1


@wp.func
def list_splats(
    size: int,
    chunk: int,
    tile_x: int,
    tile_y: int,
    splats: wp.array[vec16],
    counts: wp.array[int],
    lists: wp.array[wp.int16],
):
    """List splats under the patches that they touch (``chunk`` places a patch), and put them on_tile."""
    for patch in range(16):
        counts[patch] = 0
    k = int(0)
    while k < size:
        s = on_tile(splats[k], tile_x, tile_y)
        rect = patch_rect(s)
        splats[k] = s
        y = rect[1]
        while y < rect[3]:
            x = rect[0]
            while x < rect[2]:
                patch = y * 4 + x
                count = counts[patch]
                lists[patch * chunk + count] = wp.int16(k)
                counts[patch] = count + 1
                x += 1
            y += 1
        k += 1


@wp.func
def shape_gradients(s: vec8, w: vec8, d: vec8) -> vec16:
    """A slot's row (see :class:`ggwarp.kernels.raster.project_adjoint.SlotGradients`) from sums over pixels.

    Args:
        s: the splat on its tile: factors of dx^2, dx dy, dy^2, centre, slope, opacity.
        w: sums of its weight times the gradients of colour and depth, the depth's times x and y, and one.
        d: sums of d loss / d ln alpha times 1, x, y, x^2, xy, y^2; x and y from the tile's centre.
    """
    ox = 7.5 - s[3]
    oy = 7.5 - s[4]
    mx = d[1] + ox * d[0]
    my = d[2] + oy * d[0]
    mxx = d[3] + ox * (d[1] + mx)
    mxy = d[4] + ox * d[2] + oy * mx
    myy = d[5] + oy * (d[2] + my)
    return vec16(
        -0.5 * mxx, -mxy, -0.5 * myy, d[0] / wp.max(s[7], OPACITY_MIN),
        # The depth's plane moves with the mean.
        -2.0 * s[0] * mx - s[1] * my - s[5] * w[3],
        -s[1] * mx - 2.0 * s[2] * my - s[6] * w[3],
        w[4] + ox * w[3], w[5] + oy * w[3],
        w[0], w[1], w[2], w[3],
        w[6], 0.0, 0.0, 0.0,
    )  # fmt: skip
