# SPDX-License-Identifier: Apache-2.0
"""The adjoint of compositing in the form for a CPU: a task is a tile.

Splats are outermost, front to back: the gradients of a splat stay in registers while its patches are
walked, and are reduced over the lanes once, all together.

With q_i = f_i . d_image and w_i = alpha_i T_i, the loss changes with alpha_i by
T_i q_i - R_i / (1 - alpha_i), where R_i is what the splats behind i and the transmittance add to the
loss: d_image . image + d_T T less the w q of the splats up to i. One scalar a pixel, and no division by T.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    LOG_ALPHA_MIN,
    OPACITY_MIN,
    OPTIONS,
    TRANSMITTANCE_MIN,
    aligned,
    first_quad,
    fold_1,
    fold_2,
    fold_4,
    fold_8,
    gathered,
    load_patch,
    make_exp,
    patch_rect,
    patch_x,
    patch_y,
    quadratic,
    vec8,
)
from ggwarp.kernels.math import vec16

wp.set_module_options(OPTIONS)

CHUNK = 32
"""Splats that are fetched at a time: enough to overlap the waits for memory."""

LINE = wp.constant(wp.uint64(64))


def _make(channels: int):
    patch_channels = wp.types.matrix((channels, 16), wp.float32)
    feature_row = wp.types.vector(channels, wp.float32)
    exp = make_exp()
    groups, grouped = channels // 4, channels // 4 * 4
    # Folding leaves the totals of 16 vectors in bit-reversed order: quantity k goes to places[k].
    results = 1 if channels + 8 <= 16 else 2
    places = [r + results * int(f"{k:04b}"[::-1], 2) for r in range(results) for k in range(16)]
    moments = [places[channels + k] for k in range(8)]

    # Each function is called once, so that LLVM inlines it.
    @wp.func
    def take_products(f: feature_row, rect: wp.vec4i, g: wp.array[patch_channels], products: wp.array[vec16]):
        """q of the splat at every pixel of its patches."""
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                patch = y * 4 + x
                gp = g[patch]
                q = vec16()
                for c in range(groups):
                    part = gp[4 * c] * f[4 * c]
                    for i in range(1, 4):
                        part += gp[4 * c + i] * f[4 * c + i]
                    q += part
                for c in range(grouped, channels):
                    q += gp[c] * f[c]
                products[patch] = q

    @wp.func
    def walk(
        s: vec8,
        rect: wp.vec4i,
        g_rows: wp.array[vec16],
        products: wp.array[vec16],
        transmittances: wp.array[vec16],
        behind: wp.array[vec16],
        weights: wp.array[vec16],
        sums: wp.array[vec16],
    ):
        """Pass the splat: write its weights, and the moments of what shapes it, still by lane.

        They are those of d loss / d ln alpha, then the gradient of the depth's slope.
        """
        m0 = vec16()
        mx = vec16()
        my = vec16()
        mxx = vec16()
        mxy = vec16()
        myy = vec16()
        slope_x = vec16()
        slope_y = vec16()
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                patch = y * 4 + x
                dx = patch_x(patch) - vec16(s[0])
                dy = patch_y(patch) - vec16(s[1])
                power = wp.cw_mul(dx, dx * s[2] + dy * s[3]) + wp.cw_mul(dy, dy * s[4]) + vec16(s[5])
                raw = exp(power)
                T = transmittances[patch]
                d_depth = g_rows[patch * channels + DEPTH]
                q = products[patch] + wp.cw_mul(d_depth, dx * s[6] + dy * s[7])
                rest = behind[patch]
                w = vec16()
                d = vec16()
                for j in range(16):
                    counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                    alpha = wp.where(counted, wp.min(raw[j], ALPHA_MAX), 0.0)
                    w[j] = alpha * T[j]
                    rest[j] = rest[j] - w[j] * q[j]
                    d_alpha = T[j] * q[j] - rest[j] / (1.0 - alpha)
                    d[j] = wp.where(raw[j] < ALPHA_MAX, alpha * d_alpha, 0.0)
                    T[j] = T[j] - w[j]
                transmittances[patch] = T
                behind[patch] = rest
                weights[patch] = w
                dx_d = wp.cw_mul(d, dx)
                dy_d = wp.cw_mul(d, dy)
                m0 += d
                mx += dx_d
                my += dy_d
                mxx += wp.cw_mul(dx_d, dx)
                mxy += wp.cw_mul(dx_d, dy)
                myy += wp.cw_mul(dy_d, dy)
                d_rise = wp.cw_mul(w, d_depth)
                slope_x += wp.cw_mul(d_rise, dx)
                slope_y += wp.cw_mul(d_rise, dy)
        sums[wp.static(moments[0])] = m0
        sums[wp.static(moments[1])] = mx
        sums[wp.static(moments[2])] = my
        sums[wp.static(moments[3])] = mxx
        sums[wp.static(moments[4])] = mxy
        sums[wp.static(moments[5])] = myy
        sums[wp.static(moments[6])] = slope_x
        sums[wp.static(moments[7])] = slope_y

    @wp.func
    def take_weighted(
        rect: wp.vec4i, g: wp.array[patch_channels], weights: wp.array[vec16], sums: wp.array[vec16]
    ):
        """The gradient of the splat's features, still by lane."""
        acc = patch_channels()
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                patch = y * 4 + x
                w = weights[patch]
                gp = g[patch]
                for c in range(channels):
                    acc[c] += wp.cw_mul(w, gp[c])
        for c in range(channels):
            sums[wp.static(places[c])] = acc[c]

    @wp.func
    def fold(sums: wp.array[vec16], halves: int):
        """Sum over lanes; ``halves`` is half the vectors."""
        for i in range(halves):
            sums[i] = fold_8(sums[i], sums[i + halves])
        for i in range(halves // 2):
            sums[i] = fold_4(sums[i], sums[i + halves // 2])
        for i in range(halves // 4):
            sums[i] = fold_2(sums[i], sums[i + halves // 4])
        for i in range(halves // 8):
            sums[i] = fold_1(sums[i], sums[i + halves // 8])

    @wp.kernel(name=f"composite_cpu_adjoint_{channels}")
    def adjoint(
        offset: int,
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        means2d: wp.array[wp.vec2],
        conics: wp.array[wp.vec4],
        slopes: wp.array[wp.vec2],
        features: wp.array2d[float],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        slot_d_means2d: wp.array[wp.vec2],
        slot_d_conics: wp.array[wp.vec4],
        slot_d_slopes: wp.array[wp.vec2],
        slot_d_features: wp.array2d[float],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        quads = image.shape[2] / 4
        plane = image.shape[1] * quads
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=feature_row)
        d_features = wp.array(ptr=slot_d_features.ptr, shape=(slot_d_features.shape[0],), dtype=feature_row)
        image_quads = wp.array(ptr=image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        d_image_quads = wp.array(ptr=d_image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        T_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        d_T_quads = wp.array(ptr=d_transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        memory = wp.zeros(shape=wp.static(16 * channels + 4 * 16 + 16 * results + 1), dtype=vec16)
        address = aligned(memory.ptr)
        g = wp.array(ptr=address, shape=(16,), dtype=patch_channels)
        g_rows = wp.array(ptr=address, shape=(16 * channels,), dtype=vec16)
        address += wp.uint64(16 * channels) * LINE
        transmittances = wp.array(ptr=address, shape=(16,), dtype=vec16)
        # R of the splat at hand.
        behind = wp.array(ptr=address + wp.uint64(16) * LINE, shape=(16,), dtype=vec16)
        weights = wp.array(ptr=address + wp.uint64(32) * LINE, shape=(16,), dtype=vec16)
        products = wp.array(ptr=address + wp.uint64(48) * LINE, shape=(16,), dtype=vec16)
        address += wp.uint64(64) * LINE
        sums = wp.array(ptr=address, shape=(16 * results,), dtype=vec16)
        totals = wp.array(ptr=address, shape=(16 * results,), dtype=float)
        total_row = wp.array(ptr=address, shape=(1,), dtype=feature_row)
        slot_memory = wp.zeros(shape=CHUNK, dtype=int)
        slots = wp.array(ptr=slot_memory.ptr, shape=(CHUNK,), dtype=int)
        splat_memory = wp.zeros(shape=CHUNK, dtype=vec8)
        splats = wp.array(ptr=splat_memory.ptr, shape=(CHUNK,), dtype=vec8)
        row_memory = wp.zeros(shape=CHUNK, dtype=feature_row)
        rows = wp.array(ptr=row_memory.ptr, shape=(CHUNK,), dtype=feature_row)
        # Run-time numbers (see composite_patches).
        patches = wp.min(tiles_x, 0) + 16
        planes = image.shape[0]
        halves = wp.min(tiles_x, 0) + 8 * results
        for patch in range(patches):
            quad = first_quad(tile_x, tile_y, patch, quads)
            total = wp.cw_mul(load_patch(T_quads, quad, quads), load_patch(d_T_quads, quad, quads))
            for c in range(planes):
                d = load_patch(d_image_quads, quad + c * plane, quads)
                total += wp.cw_mul(d, load_patch(image_quads, quad + c * plane, quads))
                g_rows[patch * channels + c] = d
            behind[patch] = total
            transmittances[patch] = vec16(1.0)
        pairs = tile_ranges[tile]
        transparent = int(1)
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            most = vec16()
            for patch in range(patches):
                most = wp.max(most, transmittances[patch])
            if not (wp.max(most) >= TRANSMITTANCE_MIN):
                transparent = 0
            for k in range(size):
                slot = pair_slots[begin + k]
                gaussian = slot_gaussians[slot]
                slots[k] = slot
                splats[k] = gathered(means2d[gaussian], conics[gaussian], slopes[gaussian])
                rows[k] = feature_rows[gaussian]
            for k in range(size):
                slot = slots[k]
                s = quadratic(splats[k], tile_x, tile_y)
                rect = patch_rect(s) * transparent
                take_products(rows[k], rect, g, products)
                walk(s, rect, g_rows, products, transmittances, behind, weights, sums)
                take_weighted(rect, g, weights, sums)
                fold(sums, halves)
                d_features[slot] = total_row[0]
                x_moment = totals[channels + 1]
                y_moment = totals[channels + 2]
                # The depth's plane moves with the mean.
                d_depth = totals[DEPTH]
                slot_d_means2d[slot] = wp.vec2(
                    -2.0 * s[2] * x_moment - s[3] * y_moment - s[6] * d_depth,
                    -s[3] * x_moment - 2.0 * s[4] * y_moment - s[7] * d_depth,
                )
                slot_d_conics[slot] = wp.vec4(
                    -0.5 * totals[channels + 3],
                    -totals[channels + 4],
                    -0.5 * totals[channels + 5],
                    totals[channels] / wp.max(splats[k][5], OPACITY_MIN),
                )
                slot_d_slopes[slot] = wp.vec2(totals[channels + 6], totals[channels + 7])
            begin += size

    return adjoint


KERNELS = {channels: _make(channels) for channels in (4, 20)}
"""By the number of channels."""
