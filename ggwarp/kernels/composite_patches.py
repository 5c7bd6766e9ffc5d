# SPDX-License-Identifier: Apache-2.0
"""Pieces of the CPU form of compositing: a tile as 16 patches of 4 x 4 pixels.

A patch is one 16-wide vector, which LLVM turns into one AVX-512 register (or two of AVX2, four of
NEON). A splat touches only the patches that its ellipse's bounding box touches; compared with rows
of 16 pixels that is a third fewer.

Three habits make LLVM write what one would by hand, at up to five times the speed of the obvious code:
loops over patches and splats run to run-time numbers (Warp unrolls loops over constants); local
arrays are seen through arrays built over aligned addresses (strides become constants and no load
straddles two cache lines); sums that a loop carries are stored as whole vectors when it ends.
"""

import warp as wp

from ggwarp.kernels.math import vec16

wp.set_module_options({"enable_backward": False})

OPTIONS = {
    "enable_backward": False,
    "optimization_level": 3,
    "max_unroll": 32,
    # Multiply-adds form only where contraction may cross Warp's small functions.
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -ffp-contract=fast",
}
"""Module options of the kernels made of these pieces."""

vec8 = wp.types.vector(8, wp.float32)

DEPTH = wp.constant(3)
"""The channel of depth."""

LOG_ALPHA_MIN = wp.constant(-5.541263545158426)
ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
OPACITY_MIN = wp.constant(1.0e-30)

_LANE_X = wp.constant(vec16(0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0))
_LANE_Y = wp.constant(vec16(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0))


def make_exp():
    """Return a device exp of vectors, for one kernel only: LLVM always inlines what is called once."""

    @wp.func
    def exp(x: vec16) -> vec16:
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

    return exp


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
def first_quad(tile_x: int, tile_y: int, patch: int, quads: int) -> int:
    """Index of a patch's first four pixels in a plane that is seen as rows of ``quads`` vec4."""
    return (tile_y * 16 + (patch >> 2) * 4) * quads + tile_x * 4 + (patch & 3)


@wp.func
def load_patch(plane: wp.array[wp.vec4], quad: int, quads: int) -> vec16:
    a = plane[quad]
    b = plane[quad + quads]
    c = plane[quad + 2 * quads]
    d = plane[quad + 3 * quads]
    return vec16(
        a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3], c[0], c[1], c[2], c[3], d[0], d[1], d[2], d[3]
    )


@wp.func
def store_patch(plane: wp.array[wp.vec4], quad: int, quads: int, patches: wp.array[wp.vec4], row: int):
    """Write vector ``row`` of ``patches``, which is seen as vec4."""
    for j in range(4):
        plane[quad + j * quads] = patches[4 * row + j]


@wp.func
def gathered(mean: wp.vec2, conic: wp.vec4, slope: wp.vec2) -> vec8:
    return vec8(mean[0], mean[1], conic[0], conic[1], conic[2], conic[3], slope[0], slope[1])


@wp.func
def quadratic(s: vec8, tile_x: int, tile_y: int) -> vec8:
    """What :func:`gathered` returned, as the loops over patches want it.

    Centre from the tile's corner (2), factors of dx^2, dx dy, dy^2 in ln alpha (3), ln opacity,
    slope of the depth (2).
    """
    return vec8(
        s[0] - float(tile_x * 16),
        s[1] - float(tile_y * 16),
        -0.5 * s[2],
        -s[3],
        -0.5 * s[4],
        wp.log(wp.max(s[5], OPACITY_MIN)),
        s[6],
        s[7],
    )


@wp.func
def _span(centre: float, extent: float):
    """First and last-plus-one of the tile's four patches that [centre - extent, centre + extent] meets."""
    first = int(wp.clamp((centre - extent) * 0.25 + 0.2475, 0.0, 4.0))
    last = int(wp.clamp((centre + extent) * 0.25 + 1.0, 0.0, 4.0))
    return first, last


@wp.func
def patch_rect(s: vec8) -> wp.vec4i:
    """Patches (x0, y0, x1, y1), half open, where alpha can reach 1/255."""
    reach = (s[5] - LOG_ALPHA_MIN) / (4.0 * s[2] * s[4] - s[3] * s[3])
    if not (reach > 0.0):
        return wp.vec4i(0, 0, 0, 0)
    x0, x1 = _span(s[0], 2.0 * wp.sqrt(-reach * s[4]))
    y0, y1 = _span(s[1], 2.0 * wp.sqrt(-reach * s[2]))
    return wp.vec4i(x0, y0, x1, y1)


@wp.func
def fold_8(a: vec16, b: vec16) -> vec16:
    """Add lanes 8 apart: a's eight sums, then b's. Four kinds of fold turn 16 vectors into their totals."""
    r = vec16()
    for j in range(8):
        r[j] = a[j] + a[j + 8]
        r[j + 8] = b[j] + b[j + 8]
    return r


@wp.func
def fold_4(a: vec16, b: vec16) -> vec16:
    r = vec16()
    for j in range(4):
        r[j] = a[j] + a[j + 4]
        r[j + 4] = a[j + 8] + a[j + 12]
        r[j + 8] = b[j] + b[j + 4]
        r[j + 12] = b[j + 8] + b[j + 12]
    return r


@wp.func
def fold_2(a: vec16, b: vec16) -> vec16:
    r = vec16()
    for j in range(4):
        r[2 * j] = a[4 * j] + a[4 * j + 2]
        r[2 * j + 1] = a[4 * j + 1] + a[4 * j + 3]
        r[2 * j + 8] = b[4 * j] + b[4 * j + 2]
        r[2 * j + 9] = b[4 * j + 1] + b[4 * j + 3]
    return r


@wp.func
def fold_1(a: vec16, b: vec16) -> vec16:
    r = vec16()
    for j in range(8):
        r[j] = a[2 * j] + a[2 * j + 1]
        r[j + 8] = b[2 * j] + b[2 * j + 1]
    return r
