# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing in the form for a CPU: a task is a tile.

Patches are outermost: splats are taken in chunks, a chunk's splats are listed under the patches that
they touch, and then all channels of a patch stay in registers while its list is walked.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    LOG_ALPHA_MIN,
    OPTIONS,
    TRANSMITTANCE_MIN,
    aligned,
    first_quad,
    gathered,
    make_exp,
    patch_rect,
    patch_x,
    patch_y,
    quadratic,
    store_patch,
    vec8,
)
from ggwarp.kernels.math import vec16

wp.set_module_options(OPTIONS)

CHUNK = 128
"""Splats that are listed at a time."""


def _make(channels: int):
    rows = channels + 2
    patch_state = wp.types.matrix((rows, 16), wp.float32)
    feature_row = wp.types.vector(channels, wp.float32)
    exp = make_exp()

    @wp.kernel(name=f"composite_cpu_{channels}")
    def forward(
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
        median_depth: wp.array2d[float],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        quads = image.shape[2] / 4
        plane = image.shape[1] * quads
        feature_rows = wp.array(ptr=features.ptr, shape=(features.shape[0],), dtype=feature_row)
        image_quads = wp.array(ptr=image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        transmittance_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        median_quads = wp.array(ptr=median_depth.ptr, shape=(plane,), dtype=wp.vec4)
        # Per patch: the channels, T and the median depth.
        state_memory = wp.zeros(shape=wp.static(16 * rows + 1), dtype=vec16)
        state = wp.array(ptr=aligned(state_memory.ptr), shape=(16,), dtype=patch_state)
        state_rows = wp.array(ptr=aligned(state_memory.ptr), shape=(16 * rows,), dtype=vec16)
        state_quads = wp.array(ptr=aligned(state_memory.ptr), shape=(64 * rows,), dtype=wp.vec4)
        splat_memory = wp.zeros(shape=CHUNK, dtype=vec8)
        splats = wp.array(ptr=splat_memory.ptr, shape=(CHUNK,), dtype=vec8)
        row_memory = wp.zeros(shape=CHUNK, dtype=feature_row)
        chunk_rows = wp.array(ptr=row_memory.ptr, shape=(CHUNK,), dtype=feature_row)
        list_memory = wp.zeros(shape=wp.static(16 * CHUNK), dtype=wp.int16)
        lists = wp.array(ptr=list_memory.ptr, shape=(16 * CHUNK,), dtype=wp.int16)
        count_memory = wp.zeros(shape=16, dtype=int)
        counts = wp.array(ptr=count_memory.ptr, shape=(16,), dtype=int)
        # Run-time numbers (see composite_patches).
        patches = wp.min(tiles_x, 0) + 16
        planes = image.shape[0]
        for patch in range(patches):
            state_rows[patch * rows + channels] = vec16(1.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            for patch in range(patches):
                counts[patch] = 0
            for k in range(size):
                gaussian = slot_gaussians[pair_slots[begin + k]]
                splats[k] = gathered(means2d[gaussian], conics[gaussian], slopes[gaussian])
                chunk_rows[k] = feature_rows[gaussian]
            for k in range(size):
                s = quadratic(splats[k], tile_x, tile_y)
                rect = patch_rect(s)
                splats[k] = s
                for y in range(rect[1], rect[3]):
                    for x in range(rect[0], rect[2]):
                        patch = y * 4 + x
                        count = counts[patch]
                        lists[patch * CHUNK + count] = wp.int16(k)
                        counts[patch] = count + 1
            opaque = int(1)
            for patch in range(patches):
                acc = state[patch]
                T = acc[channels]
                if wp.max(T) >= TRANSMITTANCE_MIN:
                    opaque = 0
                    median = acc[channels + 1]
                    pixel_x = patch_x(patch)
                    pixel_y = patch_y(patch)
                    for i in range(counts[patch]):
                        k = int(lists[patch * CHUNK + i])
                        s = splats[k]
                        f = chunk_rows[k]
                        dx = pixel_x - vec16(s[0])
                        dy = pixel_y - vec16(s[1])
                        power = wp.cw_mul(dx, dx * s[2] + dy * s[3]) + wp.cw_mul(dy, dy * s[4]) + vec16(s[5])
                        alpha = wp.min(exp(power), vec16(ALPHA_MAX))
                        rise = dx * s[6] + dy * s[7]
                        depth = rise + vec16(f[DEPTH])
                        w = vec16()
                        for j in range(16):
                            counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                            w[j] = wp.where(counted, alpha[j] * T[j], 0.0)
                            after = T[j] - w[j]
                            median[j] = wp.where(T[j] >= 0.5 and after < 0.5, depth[j], median[j])
                            T[j] = after
                        for c in range(channels):
                            acc[c] += w * f[c]
                        acc[DEPTH] += wp.cw_mul(w, rise)
                    acc[channels] = T
                    acc[channels + 1] = median
                    state[patch] = acc
            begin += size
            if opaque == 1:
                begin = pairs[1]
        for patch in range(patches):
            quad = first_quad(tile_x, tile_y, patch, quads)
            for c in range(planes):
                store_patch(image_quads, quad + c * plane, quads, state_quads, patch * rows + c)
            store_patch(transmittance_quads, quad, quads, state_quads, patch * rows + channels)
            store_patch(median_quads, quad, quads, state_quads, patch * rows + channels + 1)

    return forward


KERNELS = {channels: _make(channels) for channels in (4, 20)}
"""By the number of channels."""
