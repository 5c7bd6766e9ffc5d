# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing in the form for CUDA: a block of 256 threads is a tile.

Each warp holds a patch of 8 x 4 pixels. Of 256 splats at a time a thread stages one in shared memory and
tells which of the eight patches an octagon about its ellipse meets; a vote turns this into a word of bits for
each patch and 32 splats, and a warp walks the bits that are set: what it cannot see costs it nothing. The
opacity threshold is tested on ln alpha, before exp.

Habits that keep NVRTC's code short (seen in SASS): vectors that a loop carries change in place
(``v[i] += x``; a name assigned anew under an ``if`` is copied on every path); 16-byte loads are asked for;
``lane & 255`` and ``|`` say that an index is not negative, which Warp would test for at every access.
"""

import warp as wp

from ggwarp.kernels.block import load4, load16, lowest_bit, put_int, put_quad, short_exp, sync_block, vote
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.composite_patches import (
    ALPHA_MAX,
    TRANSMITTANCE_MIN,
    diagonal_extents,
    in_lists,
    on_tile,
)
from ggwarp.kernels.raster.project import LOG_ALPHA_MIN
from ggwarp.kernels.raster.sampling import in_sample

wp.set_module_options({"enable_backward": False, "max_unroll": 16})

BLOCK = 256
WARPS = 8

WORDS = 8 * WARPS
"""Of 32 bits: a patch's splats of 256."""

SPLAT_QUADS = 3 * BLOCK


@wp.func
def pixel_column(lane: int) -> int:
    return ((lane >> 5) & 1) * 8 + (lane & 7)


@wp.func
def pixel_row(lane: int) -> int:
    return (lane >> 6) * 4 + ((lane >> 3) & 3)


@wp.func
def patches_met(s: vec16) -> int:
    """A bit for each warp's patch that the octagon about a splat's ellipse meets."""
    diagonals = diagonal_extents(s)
    met = int(0)
    for p in range(WARPS):
        # The patch's centre; its corners are 3.5 and 1.5 from it.
        x = wp.abs(float((p & 1) * 8) + 3.5 - s[4])
        y = wp.abs(float((p >> 1) * 4) + 1.5 - s[5])
        u = wp.abs(float((p & 1) * 8 + (p >> 1) * 4) + 5.0 - s[4] - s[5])
        v = wp.abs(float((p & 1) * 8 - (p >> 1) * 4) + 2.0 - s[4] + s[5])
        out = wp.max(
            wp.max(x - s[12] - 3.51, y - s[13] - 1.51), wp.max(u - diagonals[0], v - diagonals[1]) - 5.0
        )
        if out <= 0.0:
            met = met | (1 << p)
    if not in_lists(s):
        met = 0
    return met


def _make_forward(channels: int):
    with_identity = channels == 20

    @wp.kernel(name=f"composite_cuda_{channels}", launch_bounds=(BLOCK, 4 if with_identity else 5))
    def forward(
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        rows: wp.array[vec16],
        identities: wp.array[vec16],
        stride: int,
        phase: wp.array[int],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        median_depth: wp.array2d[float],
    ):
        tile, thread = wp.tid()
        lane = thread & 255
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        # The other kernel's; the same for the whole block.
        if in_sample(tile_x, tile_y, stride, phase) != wp.static(with_identity):
            return
        codes = wp.array(ptr=identities.ptr, shape=(4 * identities.shape[0],), dtype=wp.vec4)
        # Of the k-th splat: at k the factors of dx^2, dx dy, dy^2 in ln alpha, and ln opacity; at 256 + k
        # centre and slope; at 512 + k colour and depth.
        splats = wp.tile_empty(shape=SPLAT_QUADS, dtype=wp.vec4, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        words = wp.tile_empty(shape=WORDS, dtype=int, storage="shared")
        x = float(pixel_column(lane))
        y = float(pixel_row(lane))
        head = wp.vec4()
        e0 = wp.vec4()
        e1 = wp.vec4()
        e2 = wp.vec4()
        e3 = wp.vec4()
        T = float(1.0)
        median = float(0.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, BLOCK)
            met = int(0)
            if lane < size:
                gaussian = slot_gaussians[pair_slots[begin + lane]]
                s = on_tile(load16(rows, gaussian), tile_x, tile_y)
                put_quad(splats, lane, wp.vec4(s[0], s[1], s[2], s[14]))
                put_quad(splats, BLOCK | lane, wp.vec4(s[4], s[5], s[6], s[7]))
                put_quad(splats, 2 * BLOCK | lane, wp.vec4(s[8], s[9], s[10], s[11]))
                put_int(gaussians, lane, gaussian)
                met = patches_met(s)
            for p in range(WARPS):
                vote(words, p * 8 + (lane >> 5), lane, (met & (1 << p)) != 0)
            sync_block()
            base = int(0)
            while base < size and T >= TRANSMITTANCE_MIN:
                bits = words[((lane >> 2) & 56) | (base >> 5)]
                while bits != 0:
                    k = (base | lowest_bit(bits)) & 255
                    bits = bits & (bits - 1)
                    shape = splats[k]
                    place = splats[BLOCK | k]
                    dx = x - place[0]
                    dy = y - place[1]
                    power = dx * (dx * shape[0] + dy * shape[1]) + dy * dy * shape[2] + shape[3]
                    if power >= LOG_ALPHA_MIN:
                        w = wp.min(short_exp(power), ALPHA_MAX) * T
                        f = splats[2 * BLOCK | k]
                        depth = f[3] + dx * place[2] + dy * place[3]
                        head[0] += f[0] * w
                        head[1] += f[1] * w
                        head[2] += f[2] * w
                        head[3] += depth * w
                        if wp.static(with_identity):
                            at = 4 * gaussians[k]
                            c0 = load4(codes, at)
                            c1 = load4(codes, at + 1)
                            c2 = load4(codes, at + 2)
                            c3 = load4(codes, at + 3)
                            for c in range(4):
                                e0[c] += c0[c] * w
                                e1[c] += c1[c] * w
                                e2[c] += c2[c] * w
                                e3[c] += c3[c] * w
                        after = T - w
                        if T >= 0.5 and after < 0.5:
                            median = depth
                        T = after
                        if T < TRANSMITTANCE_MIN:
                            bits = 0
                base += 32
            # Also the barrier before shared memory is written again.
            transparent = wp.tile_sum(wp.tile(wp.where(T >= TRANSMITTANCE_MIN, 1, 0)))
            begin += size
            if transparent[0] == 0:
                begin = pairs[1]
        row = tile_y * 16 + pixel_row(lane)
        column = tile_x * 16 + pixel_column(lane)
        for c in range(4):
            image[c, row, column] = head[c]
        if wp.static(with_identity):
            for c in range(4):
                image[4 + c, row, column] = e0[c]
                image[8 + c, row, column] = e1[c]
                image[12 + c, row, column] = e2[c]
                image[16 + c, row, column] = e3[c]
        transmittance[row, column] = T
        median_depth[row, column] = median

    return forward


FORWARD = {channels: _make_forward(channels) for channels in (4, 20)}
"""By the number of channels."""
