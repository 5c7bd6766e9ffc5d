# SPDX-License-Identifier: Apache-2.0
"""The adjoint of compositing in the form for a CPU: a task is a tile.

Patches are outermost, as in the forward form. With q_i = f_i . d_image and w_i = alpha_i T_i, the loss
changes with alpha_i by T_i q_i - R_i / (1 - alpha_i), where R_i is what the splats behind i and the
transmittance add to the loss: d_image . image + d_T T less the w q of the splats up to i. One scalar a
pixel, and no division by T.

A patch's list is walked four times, each time with what it needs in registers: the products q, lanes
being pixels; w and d loss / d ln alpha, front to back; then the sums over pixels, where lanes are
*gradients*: each pixel adds its row of d_image, or of the monomials 1, x, y, x^2, xy, y^2 that shape
gradients are made of, times one number. So nothing is ever summed across lanes.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    LINE,
    OPTIONS,
    TRANSMITTANCE_MIN,
    aligned,
    any_at_least,
    depth_at,
    first_quad,
    log_alpha,
    make_exp,
    on_tile,
    patch_rect,
    patch_x,
    patch_y,
    shape_gradients,
    vec8,
)
from ggwarp.kernels.math import vec16
from ggwarp.kernels.project import LOG_ALPHA_MIN

wp.set_module_options(OPTIONS)

CHUNK = 64
"""Splats that are listed at a time."""

mat16 = wp.types.matrix((16, 16), wp.float32)
mat16x8 = wp.types.matrix((16, 8), wp.float32)


@wp.func
def _centred(patch: int, lane: int) -> wp.vec2:
    """A pixel's place from the tile's centre: moments about the splat follow with the least cancellation."""
    return wp.vec2(float((patch & 3) * 4 + (lane & 3)) - 7.5, float((patch >> 2) * 4 + (lane >> 2)) - 7.5)


def _make(channels: int):
    lines = 2 if channels == 20 else 1
    patch_channels = wp.types.matrix((channels, 16), wp.float32)
    tile_lines = 16 * (20 + channels + 16 * (lines - 1)) + 1
    chunk_lines = CHUNK * (2 * lines + 3) + 1
    exp = make_exp()

    @wp.kernel(name=f"composite_cpu_adjoint_{channels}")
    def adjoint(
        offset: int,
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        rows: wp.array[vec16],
        identities: wp.array[vec16],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        d_image: wp.array3d[float],
        d_transmittance: wp.array2d[float],
        identity_shapes: int,
        slot_rows: wp.array[vec16],
        slot_identities: wp.array[vec16],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        quads = image.shape[2] / 4
        plane = image.shape[1] * quads
        image_quads = wp.array(ptr=image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        d_image_quads = wp.array(ptr=d_image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        T_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        d_T_quads = wp.array(ptr=d_transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        # Strides that are known make short addresses.
        slot_list = wp.array(ptr=pair_slots.ptr, shape=(pair_slots.shape[0],), dtype=int)
        gaussian_list = wp.array(ptr=slot_gaussians.ptr, shape=(slot_gaussians.shape[0],), dtype=int)
        row_lines = wp.array(ptr=rows.ptr, shape=(rows.shape[0],), dtype=vec16)
        identity_lines = wp.array(ptr=identities.ptr, shape=(identities.shape[0],), dtype=vec16)
        slot_lines = wp.array(ptr=slot_rows.ptr, shape=(slot_rows.shape[0],), dtype=vec16)
        slot_identity_lines = wp.array(
            ptr=slot_identities.ptr, shape=(slot_identities.shape[0],), dtype=vec16
        )

        # Of the tile: gradients of the planes by patch, pixels in lanes; by pixel, in lanes channels;
        # the rows that w and d loss / d ln alpha multiply; T and R.
        memory = wp.zeros(shape=tile_lines, dtype=vec16)
        address = aligned(memory.ptr)
        g = wp.array(ptr=address, shape=(16,), dtype=patch_channels)
        g_quads = wp.array(ptr=address, shape=(64 * channels,), dtype=wp.vec4)
        g_floats = wp.array(ptr=address, shape=(256 * channels,), dtype=float)
        address += wp.static(wp.uint64(16 * 64 * channels))
        by_weight = wp.array(ptr=address, shape=(16,), dtype=mat16x8)
        weight_rows = wp.array(ptr=address, shape=(256,), dtype=vec8)
        address += wp.uint64(128) * LINE
        by_slope = wp.array(ptr=address, shape=(16,), dtype=mat16x8)
        slope_rows = wp.array(ptr=address, shape=(256,), dtype=vec8)
        address += wp.uint64(128) * LINE
        transmittances = wp.array(ptr=address, shape=(16,), dtype=vec16)
        behind = wp.array(ptr=address + wp.uint64(16) * LINE, shape=(16,), dtype=vec16)
        behind_quads = wp.array(ptr=address + wp.uint64(16) * LINE, shape=(64,), dtype=wp.vec4)
        pixels = wp.array(ptr=address + wp.uint64(32) * LINE, shape=(32,), dtype=vec16)
        address += wp.uint64(64) * LINE
        turned = wp.array(ptr=address, shape=(16,), dtype=mat16)
        turned_floats = wp.array(ptr=address, shape=(4096,), dtype=float)

        # Of a chunk: its splats, the sums over pixels, and per patch the list and what is found on the way.
        chunk_memory = wp.zeros(shape=chunk_lines, dtype=vec16)
        address = aligned(chunk_memory.ptr)
        splats = wp.array(ptr=address, shape=(lines * CHUNK,), dtype=vec16)
        address += wp.static(wp.uint64(64 * lines * CHUNK))
        identity_sums = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
        address += wp.static(wp.uint64(64 * (lines - 1) * CHUNK))
        sums = wp.array(ptr=address, shape=(2 * CHUNK,), dtype=vec8)
        sum_lines = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
        address += wp.static(wp.uint64(64 * CHUNK))
        products = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
        address += wp.static(wp.uint64(64 * CHUNK))
        weights = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
        address += wp.static(wp.uint64(64 * CHUNK))
        slopes = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
        slot_memory = wp.zeros(shape=CHUNK, dtype=int)
        slots = wp.array(ptr=slot_memory.ptr, shape=(CHUNK,), dtype=int)
        gaussian_memory = wp.zeros(shape=CHUNK, dtype=int)
        gaussians = wp.array(ptr=gaussian_memory.ptr, shape=(CHUNK,), dtype=int)
        list_memory = wp.zeros(shape=wp.static(16 * CHUNK), dtype=wp.int16)
        lists = wp.array(ptr=list_memory.ptr, shape=(16 * CHUNK,), dtype=wp.int16)
        count_memory = wp.zeros(shape=16, dtype=int)
        counts = wp.array(ptr=count_memory.ptr, shape=(16,), dtype=int)

        # Run-time numbers (see composite_patches).
        patches = wp.min(tiles_x, 0) + 16
        shaping = 4 + (channels - 4) * identity_shapes
        for patch in range(patches):
            for j in range(4):
                quad = first_quad(tile_x, tile_y, patch, quads) + j * quads
                total = wp.vec4() + wp.cw_mul(T_quads[quad], d_T_quads[quad])
                c = int(0)
                while c < channels:
                    d_quad = d_image_quads[quad + c * plane]
                    if c < shaping:
                        total += wp.cw_mul(d_quad, image_quads[quad + c * plane])
                    g_quads[(patch * channels + c) * 4 + j] = d_quad
                    c += 1
                behind_quads[patch * 4 + j] = total
            if wp.static(lines == 2):
                for lane in range(patches):
                    for c in range(16):
                        turned_floats[patch * 256 + lane * 16 + c] = g_floats[
                            (patch * channels + 4 + c) * 16 + lane
                        ]
            transmittances[patch] = vec16(1.0)
            pixels[patch] = patch_x(patch)
            pixels[16 + patch] = patch_y(patch)
            for lane in range(patches):
                uv = _centred(patch, lane)
                first = patch * wp.static(16 * channels) + lane
                g_depth = g_floats[first + 48]
                weight_rows[patch * 16 + lane] = vec8(
                    g_floats[first], g_floats[first + 16], g_floats[first + 32], g_depth,
                    g_depth * uv[0], g_depth * uv[1], 0.0, 0.0,
                )  # fmt: skip
                slope_rows[patch * 16 + lane] = vec8(
                    1.0, uv[0], uv[1], uv[0] * uv[0], uv[0] * uv[1], uv[1] * uv[1], 0.0, 0.0
                )
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            for patch in range(patches):
                # A finished patch lists nothing.
                counts[patch] = 0
            # Few instructions a splat: so many of the waits for memory overlap.
            k = int(0)
            while k < size:
                slots[k] = slot_list[begin + k]
                k += 1
            k = int(0)
            while k < size:
                gaussians[k] = gaussian_list[slots[k]]
                k += 1
            k = int(0)
            while k < size:
                splats[k * lines] = row_lines[gaussians[k]]
                k += 1
            if wp.static(lines == 2):
                k = int(0)
                while k < size:
                    splats[k * 2 + 1] = identity_lines[gaussians[k]]
                    identity_sums[k] = vec16()
                    k += 1
            k = int(0)
            while k < size:
                s = on_tile(splats[k * lines], tile_x, tile_y)
                rect = patch_rect(s)
                splats[k * lines] = s
                sum_lines[k] = vec16()
                y = rect[1]
                while y < rect[3]:
                    x = rect[0]
                    while x < rect[2]:
                        patch = y * 4 + x
                        count = counts[patch]
                        lists[patch * CHUNK + count] = wp.int16(k)
                        counts[patch] = count + 1
                        x += 1
                    y += 1
                k += 1
            for patch in range(patches):
                T = transmittances[patch]
                count = counts[patch]
                if any_at_least(T, TRANSMITTANCE_MIN) and count > 0:
                    gp = g[patch]
                    i = int(0)
                    while i < count:
                        s = splats[int(lists[patch * CHUNK + i]) * lines]
                        q = vec16()
                        for c in range(3):
                            q += gp[c] * s[8 + c]
                        products[i] = q
                        i += 1
                    if wp.static(lines == 2):
                        if identity_shapes != 0:
                            i = int(0)
                            while i < count:
                                f = splats[int(lists[patch * CHUNK + i]) * 2 + 1]
                                q = products[i]
                                for c in range(16):
                                    q += gp[4 + c] * f[c]
                                products[i] = q
                                i += 1
                    rest = behind[patch]
                    d_depth = gp[DEPTH]
                    pixel_x = pixels[patch]
                    pixel_y = pixels[16 + patch]
                    i = int(0)
                    while i < count:
                        s = splats[int(lists[patch * CHUNK + i]) * lines]
                        dx = pixel_x - vec16(s[4])
                        dy = pixel_y - vec16(s[5])
                        power = log_alpha(s, dx, dy)
                        raw = exp(power)
                        q = products[i] + wp.cw_mul(d_depth, depth_at(s, dx, dy))
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
                        weights[i] = w
                        slopes[i] = d
                        i += 1
                    transmittances[patch] = T
                    behind[patch] = rest
                    if wp.static(lines == 2):
                        gt = turned[patch]
                        i = int(0)
                        while i < count:
                            k = int(lists[patch * CHUNK + i])
                            w = weights[i]
                            features = identity_sums[k]
                            for p in range(16):
                                features += gt[p] * w[p]
                            identity_sums[k] = features
                            i += 1
                    gw = by_weight[patch]
                    i = int(0)
                    while i < count:
                        k = 2 * int(lists[patch * CHUNK + i])
                        w = weights[i]
                        head = sums[k]
                        for p in range(16):
                            head += gw[p] * w[p]
                        sums[k] = head
                        i += 1
                    gs = by_slope[patch]
                    i = int(0)
                    while i < count:
                        k = 2 * int(lists[patch * CHUNK + i]) + 1
                        d = slopes[i]
                        moments = sums[k]
                        for p in range(16):
                            moments += gs[p] * d[p]
                        sums[k] = moments
                        i += 1
            k = int(0)
            while k < size:
                s = splats[k * lines]
                geometry = vec8(s[0], s[1], s[2], s[4], s[5], s[6], s[7], s[3])
                slot_lines[slots[k]] = shape_gradients(geometry, sums[2 * k], sums[2 * k + 1])
                if wp.static(lines == 2):
                    slot_identity_lines[slots[k]] = identity_sums[k]
                k += 1
            begin += size

    return adjoint


KERNELS = {channels: _make(channels) for channels in (4, 20)}
"""By the number of channels."""
