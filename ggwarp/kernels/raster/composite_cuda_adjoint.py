# SPDX-License-Identifier: Apache-2.0
"""The adjoint of compositing in the form for CUDA: a block of 256 threads is a tile, a warp a patch of 8 x 4.

Of 32 splats at a time a warp walks those that its patch can see, 16 in a group, and lays their weights and
d loss / d ln alpha in shared memory by splat and pixel. Then its lanes change sides and sum over pixels
(:mod:`ggwarp.kernels.raster.composite_cuda_sums`). The sums of the eight warps, kept apart, are added in a
fixed order where a warp saw the splat: a row per (splat, tile) slot, no atomics, and the same result every
time. See :mod:`ggwarp.kernels.raster.composite_cuda` for how it is known what a warp sees, and for habits.
"""

import warp as wp

from ggwarp.kernels.block import (
    any_in_warp,
    from_other_half,
    goes_on,
    load4,
    load16,
    lowest_bit,
    put_float,
    put_int,
    put_quad,
    short_exp,
    short_ratio,
    store4,
    store16,
    sync_block,
    sync_warp,
    vote,
)
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.composite_cuda import (
    BLOCK,
    SPLAT_QUADS,
    WARPS,
    WORDS,
    patches_met,
    pixel_column,
    pixel_row,
)
from ggwarp.kernels.raster.composite_cuda_sums import (
    GROUP,
    HALF_QUADS,
    ROW_QUADS,
    code_sums,
    head_sums,
    moments,
)
from ggwarp.kernels.raster.composite_patches import (
    ALPHA_MAX,
    TRANSMITTANCE_MIN,
    on_tile,
    shape_gradients,
    vec8,
)
from ggwarp.kernels.raster.project import LOG_ALPHA_MIN
from ggwarp.kernels.raster.sampling import in_sample

wp.set_module_options({"enable_backward": False, "max_unroll": 16})

GROUPS = 2
"""Of the 32 splats whose sums are kept until all warps have theirs."""

WARP_QUADS = 2 * GROUP * ROW_QUADS
WALK_QUADS = WARPS * WARP_QUADS
PIXEL_QUADS = 2 * WARPS * HALF_QUADS

SUM_QUADS = 128
PART_QUADS = WARPS * SUM_QUADS


def _make_adjoint(channels: int):
    with_identity = channels == 20

    # Two blocks' shared memory fit a multiprocessor with identities, three without.
    @wp.kernel(name=f"composite_cuda_adjoint_{channels}", launch_bounds=(BLOCK, 2 if with_identity else 3))
    def adjoint(
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
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        identity_shapes: int,
        slot_rows: wp.array[vec16],
        slot_identities: wp.array[vec16],
    ):
        tile, thread = wp.tid()
        lane = thread & 255
        warp = lane >> 5
        member = lane & 31
        tile_y = tile / tiles_x
        tile_x = tile - tile_y * tiles_x
        # The other kernel's; the same for the whole block.
        if in_sample(tile_x, tile_y, stride, phase) != wp.static(with_identity):
            return
        codes = wp.array(ptr=identities.ptr, shape=(4 * identities.shape[0],), dtype=wp.vec4)
        image_quads = wp.array(
            ptr=d_image.ptr, shape=(d_image.shape[0] * d_image.shape[1] * tiles_x * 4,), dtype=wp.vec4
        )
        code_rows = wp.array(ptr=slot_identities.ptr, shape=(4 * slot_identities.shape[0],), dtype=wp.vec4)
        splats = wp.tile_empty(shape=SPLAT_QUADS, dtype=wp.vec4, storage="shared")
        gaussians = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        slots = wp.tile_empty(shape=BLOCK, dtype=int, storage="shared")
        words = wp.tile_empty(shape=WORDS, dtype=int, storage="shared")
        # Of each warp: which of the 32 splats it has sums of.
        summed = wp.tile_empty(shape=WARPS, dtype=int, storage="shared")
        # Of each warp: rows of w, then of d loss / d ln alpha.
        walked = wp.tile_empty(shape=WALK_QUADS, dtype=wp.vec4, storage="shared")
        gradients = wp.tile_empty(shape=PIXEL_QUADS, dtype=wp.vec4, storage="shared")
        # Of each warp, then of the tile: four quads of 32 splats.
        parts = wp.tile_empty(shape=PART_QUADS, dtype=wp.vec4, storage="shared")
        sums = wp.tile_empty(shape=SUM_QUADS, dtype=wp.vec4, storage="shared")

        x = float(pixel_column(lane))
        y = float(pixel_row(lane))
        row = tile_y * 16 + pixel_row(lane)
        column = tile_x * 16 + pixel_column(lane)
        half = member >> 4
        to_half = (lane >> 4) * HALF_QUADS
        to_pixel = to_half + (lane & 15)
        to_row = warp * WARP_QUADS + (member & 15) * ROW_QUADS + 4 * half
        # The lane's half of the patch, from the tile's centre: moments about the splat follow with the least
        # cancellation.
        x0 = float((warp & 1) * 8) - 7.5
        y0 = float((warp >> 1) * 4 + 2 * half) - 7.5
        # Of quads of d_image: from a channel to the next; the patch's first, in the first of the identity's.
        to_channel = d_image.shape[1] * tiles_x * 4
        to_patch = (
            4 * to_channel + (tile_y * 16 + (warp >> 1) * 4) * tiles_x * 4 + tile_x * 4 + (warp & 1) * 2
        )
        g = wp.vec4()
        # What the splats behind the one at hand, and the transmittance, add to the loss.
        rest = transmittance[row, column] * d_transmittance[row, column]
        for c in range(4):
            g[c] = d_image[c, row, column]
            rest += g[c] * image[c, row, column]
        put_quad(gradients, to_pixel, g)
        if wp.static(with_identity):
            code_parts = wp.tile_empty(shape=PART_QUADS, dtype=wp.vec4, storage="shared")
            g0 = wp.vec4()
            g1 = wp.vec4()
            g2 = wp.vec4()
            g3 = wp.vec4()
            for c in range(4):
                g0[c] = d_image[4 + c, row, column]
                g1[c] = d_image[8 + c, row, column]
                g2[c] = d_image[12 + c, row, column]
                g3[c] = d_image[16 + c, row, column]
                if identity_shapes != 0:
                    rest += g0[c] * image[4 + c, row, column]
                    rest += g1[c] * image[8 + c, row, column]
                    rest += g2[c] * image[12 + c, row, column]
                    rest += g3[c] * image[16 + c, row, column]
        T = float(1.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        transparent = int(1)
        while begin < pairs[1] and transparent != 0:
            size = wp.min(pairs[1] - begin, BLOCK)
            met = int(0)
            if lane < size:
                slot = pair_slots[begin + lane]
                gaussian = slot_gaussians[slot]
                s = on_tile(load16(rows, gaussian), tile_x, tile_y)
                put_quad(splats, lane, wp.vec4(s[0], s[1], s[2], s[14]))
                put_quad(splats, BLOCK | lane, wp.vec4(s[4], s[5], s[6], s[7]))
                put_quad(splats, 2 * BLOCK | lane, wp.vec4(s[8], s[9], s[10], s[11]))
                put_int(gaussians, lane, gaussian)
                put_int(slots, lane, slot)
                met = patches_met(s)
            for p in range(WARPS):
                vote(words, p * 8 + warp, lane, (met & (1 << p)) != 0)
            sync_block()
            base = int(0)
            while base < size:
                word = words[((lane >> 2) & 56) | (base >> 5)]
                left = int(0)
                left += word
                turn = int(0)
                while goes_on(left, turn, GROUPS):
                    turn += 1
                    if not any_in_warp(T >= TRANSMITTANCE_MIN):
                        break
                    count = int(0)
                    # Of the lane's two rows, 8 apart.
                    low = int(0)
                    high = int(0)
                    while left != 0 and count < GROUP:
                        k = lowest_bit(left) & 31
                        left = left & (left - 1)
                        if count == (member & 7):
                            low = k
                        if count == (member & 7) + 8:
                            high = k
                        k = (base | k) & 255
                        shape = splats[k]
                        place = splats[BLOCK | k]
                        dx = x - place[0]
                        dy = y - place[1]
                        power = dx * (dx * shape[0] + dy * shape[1]) + dy * dy * shape[2] + shape[3]
                        w = float(0.0)
                        d = float(0.0)
                        if power >= LOG_ALPHA_MIN and T >= TRANSMITTANCE_MIN:
                            raw = short_exp(power)
                            alpha = wp.min(raw, ALPHA_MAX)
                            f = splats[2 * BLOCK | k]
                            q = float(0.0)
                            q += f[0] * g[0] + f[1] * g[1] + f[2] * g[2]
                            q += (f[3] + dx * place[2] + dy * place[3]) * g[3]
                            if wp.static(with_identity):
                                if identity_shapes != 0:
                                    at = 4 * gaussians[k]
                                    q += wp.dot(load4(codes, at), g0)
                                    q += wp.dot(load4(codes, at + 1), g1)
                                    q += wp.dot(load4(codes, at + 2), g2)
                                    q += wp.dot(load4(codes, at + 3), g3)
                            w += alpha * T
                            rest -= w * q
                            if raw < ALPHA_MAX:
                                d += alpha * (T * q - short_ratio(rest, 1.0 - alpha))
                            T -= w
                        at_float = 4 * (warp * WARP_QUADS + count * ROW_QUADS) + member
                        put_float(walked, at_float, w)
                        put_float(walked, at_float + 4 * GROUP * ROW_QUADS, d)
                        count += 1
                    sync_warp()
                    if wp.static(with_identity):
                        channels = member >> 3
                        a, b = code_sums(
                            walked,
                            warp * WARP_QUADS + (member & 7) * ROW_QUADS,
                            image_quads,
                            to_patch + channels * 4 * to_channel,
                            tiles_x * 4,
                            to_channel,
                        )
                        to_code = warp * SUM_QUADS + 32 * channels
                        if (member & 7) < count:
                            put_quad(code_parts, to_code + low, a)
                        if (member & 7) + 8 < count:
                            put_quad(code_parts, to_code + high, b)
                    p0, p1 = head_sums(walked, gradients, to_row, to_half, x0, y0)
                    p2, p3 = moments(walked, to_row + GROUP * ROW_QUADS, x0, y0)
                    p0 += from_other_half(p0, walked, warp * WARP_QUADS, member)
                    p1 += from_other_half(p1, walked, warp * WARP_QUADS, member)
                    p2 += from_other_half(p2, walked, warp * WARP_QUADS, member)
                    p3 += from_other_half(p3, walked, warp * WARP_QUADS, member)
                    if (member & 15) < count:
                        to_part = warp * SUM_QUADS + 64 * half + wp.where((member & 8) == 0, low, high)
                        put_quad(parts, to_part, wp.where(half == 0, p0, p2))
                        put_quad(parts, to_part + 32, wp.where(half == 0, p1, p3))
                    # The rows are read, and may be written again.
                    sync_warp()
                if member == 0:
                    put_int(summed, warp, word & ~left)
                sync_block()
                # A thread adds the warps' parts of one quad: of rows in the first half of the block, of
                # identities in the second.
                total = wp.vec4()
                if lane < SUM_QUADS:
                    for p in range(WARPS):
                        if (summed[p] & (1 << member)) != 0:
                            total += parts[p * SUM_QUADS + lane]
                    put_quad(sums, lane, total)
                if wp.static(with_identity):
                    if lane >= SUM_QUADS and base + member < size:
                        # The stride is never 0 here: unasked, all parts are read ahead, and registers spill.
                        for p in range(WARPS):
                            if (summed[p] & (1 << member)) != 0 and stride > 0:
                                total += code_parts[p * SUM_QUADS + (lane & 127)]
                        store4(code_rows, 4 * slots[base | member] + (warp & 3), total)
                sync_block()
                if warp == base >> 5 and base + member < size:
                    k = base | member
                    shape = splats[k]
                    place = splats[BLOCK | k]
                    s0 = sums[member]
                    s1 = sums[32 | member]
                    s2 = sums[64 | member]
                    s3 = sums[96 | member]
                    found = shape_gradients(
                        vec8(
                            shape[0], shape[1], shape[2],
                            place[0], place[1], place[2], place[3], wp.exp(shape[3]),
                        ),
                        vec8(s0[0], s0[1], s0[2], s0[3], s1[0], s1[1], s1[2], 0.0),
                        vec8(s2[0], s2[1], s2[2], s2[3], s3[0], s3[1], 0.0, 0.0),
                    )  # fmt: skip
                    store16(slot_rows, slots[k], found)
                    if wp.static(not with_identity):
                        if stride > 0:
                            store16(slot_identities, slots[k], vec16())
                base += 32
            # Also the barrier before shared memory is written again.
            clear = wp.tile_sum(wp.tile(wp.where(T >= TRANSMITTANCE_MIN, 1, 0)))
            transparent = clear[0]
            begin += size
        for pair in range(begin + lane, pairs[1], BLOCK):
            slot = pair_slots[pair]
            store16(slot_rows, slot, vec16())
            if stride > 0:
                store16(slot_identities, slot, vec16())

    return adjoint


ADJOINT = {channels: _make_adjoint(channels) for channels in (4, 20)}
"""By the number of channels."""
