# SPDX-License-Identifier: Apache-2.0
"""Pieces of compositing, most of them of its CPU form: a tile as 16 patches of 4 x 4 pixels.

A patch is one 16-wide vector, which LLVM turns into one AVX-512 register (or two of AVX2, four of
NEON). A splat is listed under the patches that an octagon about its ellipse, where alpha is 1/255, meets.

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
vec16i = wp.types.vector(16, wp.int32)

DEPTH = wp.constant(3)
"""The channel of depth."""

ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
OPACITY_MIN = wp.constant(1.0e-30)
LINE = wp.constant(wp.uint64(64))
"""Bytes of a cache line, and of a vec16."""

_LANE_X = wp.constant(vec16(0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0))
_LANE_Y = wp.constant(vec16(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0))


# Patches' centres from the tile's corner.
_PATCH_X = wp.constant(vec16(*[4.0 * (j % 4) + 1.5 for j in range(16)]))
_PATCH_Y = wp.constant(vec16(*[4.0 * (j // 4) + 1.5 for j in range(16)]))


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
def diagonal_extents(s: vec16) -> wp.vec2:
    """How large x + y and x - y can be, from the centre, where alpha reaches 1/255.

    With s[12] and s[13], which say so of x and y: an octagon about the ellipse, and a little for rounding.
    """
    both = s[12] * s[12] + s[13] * s[13]
    # The ellipse's covariance, in the extents' unit.
    cross = -s[1] / s[2] * s[12] * s[12]
    slack = 0.02 + 1.0e-3 * (s[12] + s[13])
    return wp.vec2(
        wp.sqrt(wp.max(both + cross, 0.0)) + slack,
        wp.sqrt(wp.max(both - cross, 0.0)) + slack,
    )


@wp.func
def in_lists(s: vec16) -> bool:
    """Whether a splat's place and size are numbers: false for NaN, which has no place in the lists."""
    return s[12] + s[13] + wp.abs(s[4]) + wp.abs(s[5]) < 1.0e9


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
    """List splats under the patches that they can reach (``chunk`` places a patch), and put them on_tile.

    Every splat is written to every list, and its place taken by the next unless it belongs there: no
    branches, which a CPU would guess wrong.
    """
    count_line = wp.array(ptr=counts.ptr, shape=(1,), dtype=vec16i)
    count_line[0] = vec16i()
    k = int(0)
    while k < size:
        s = on_tile(splats[k], tile_x, tile_y)
        splats[k] = s
        diagonals = diagonal_extents(s)
        x = _PATCH_X - vec16(s[4])
        y = _PATCH_Y - vec16(s[5])
        room = wp.min(vec16(s[12] + 1.51) - wp.abs(x), vec16(s[13] + 1.51) - wp.abs(y))
        room = wp.min(room, vec16(diagonals[0] + 3.0) - wp.abs(x + y))
        room = wp.min(room, vec16(diagonals[1] + 3.0) - wp.abs(x - y))
        least = wp.where(in_lists(s), 0.0, wp.inf)
        reached = vec16i()
        for j in range(16):
            reached[j] = wp.where(room[j] >= least, 1, 0)
        for j in range(16):
            lists[j * chunk + counts[j]] = wp.int16(k)
        count_line[0] = count_line[0] + reached
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
