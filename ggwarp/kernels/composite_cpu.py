# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing in the form for a CPU: a task is a tile.

Patches are outermost: splats are taken in chunks, a chunk's splats are listed under the patches that
they touch, and then all channels of a patch stay in registers while its list is walked.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    OPTIONS,
    TRANSMITTANCE_MIN,
    aligned,
    depth_at,
    first_quad,
    log_alpha,
    make_exp,
    on_tile,
    patch_rect,
    patch_x,
    patch_y,
    store_patch,
)
from ggwarp.kernels.math import vec16
from ggwarp.kernels.project import LOG_ALPHA_MIN

wp.set_module_options(OPTIONS)

CHUNK = 128
"""Splats that are listed at a time."""


def _make(channels: int):
    held = channels + 2
    patch_state = wp.types.matrix((held, 16), wp.float32)
    lines = 2 if channels == 20 else 1
    exp = make_exp()

    @wp.kernel(name=f"composite_cpu_{channels}")
    def forward(
        offset: int,
        tiles_x: int,
        pair_slots: wp.array[int],
        slot_gaussians: wp.array[int],
        tile_ranges: wp.array[wp.vec2i],
        rows: wp.array[vec16],
        identities: wp.array[vec16],
        image: wp.array3d[float],
        transmittance: wp.array2d[float],
        median_depth: wp.array2d[float],
    ):
        tile = offset + wp.tid()
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        quads = image.shape[2] / 4
        plane = image.shape[1] * quads
        image_quads = wp.array(ptr=image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        transmittance_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        median_quads = wp.array(ptr=median_depth.ptr, shape=(plane,), dtype=wp.vec4)
        # Per patch: the channels, T and the median depth.
        state_memory = wp.zeros(shape=wp.static(16 * held + 1), dtype=vec16)
        state = wp.array(ptr=aligned(state_memory.ptr), shape=(16,), dtype=patch_state)
        state_rows = wp.array(ptr=aligned(state_memory.ptr), shape=(16 * held,), dtype=vec16)
        state_quads = wp.array(ptr=aligned(state_memory.ptr), shape=(64 * held,), dtype=wp.vec4)
        splat_memory = wp.zeros(shape=wp.static(lines * CHUNK + 1), dtype=vec16)
        splats = wp.array(ptr=aligned(splat_memory.ptr), shape=(lines * CHUNK,), dtype=vec16)
        splat_floats = wp.array(ptr=aligned(splat_memory.ptr), shape=(16 * lines * CHUNK,), dtype=float)
        list_memory = wp.zeros(shape=wp.static(16 * CHUNK), dtype=wp.int16)
        lists = wp.array(ptr=list_memory.ptr, shape=(16 * CHUNK,), dtype=wp.int16)
        count_memory = wp.zeros(shape=16, dtype=int)
        counts = wp.array(ptr=count_memory.ptr, shape=(16,), dtype=int)
        # Run-time numbers (see composite_patches).
        patches = wp.min(tiles_x, 0) + 16
        planes = image.shape[0]
        for patch in range(patches):
            state_rows[patch * held + channels] = vec16(1.0)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            for patch in range(patches):
                counts[patch] = 0
            for k in range(size):
                gaussian = slot_gaussians[pair_slots[begin + k]]
                splats[k * lines] = rows[gaussian]
                if wp.static(lines == 2):
                    splats[k * lines + 1] = identities[gaussian]
            for k in range(size):
                s = on_tile(splats[k * lines], tile_x, tile_y)
                rect = patch_rect(s)
                splats[k * lines] = s
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
                        k = int(lists[patch * CHUNK + i]) * lines
                        s = splats[k]
                        dx = pixel_x - vec16(s[4])
                        dy = pixel_y - vec16(s[5])
                        power = log_alpha(s, dx, dy)
                        alpha = wp.min(exp(power), vec16(ALPHA_MAX))
                        depth = depth_at(s, dx, dy)
                        features = 16 * k + 8
                        w = vec16()
                        for j in range(16):
                            counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                            w[j] = wp.where(counted, alpha[j] * T[j], 0.0)
                            after = T[j] - w[j]
                            median[j] = wp.where(T[j] >= 0.5 and after < 0.5, depth[j], median[j])
                            T[j] = after
                        for c in range(3):
                            acc[c] += w * splat_floats[features + c]
                        acc[DEPTH] += wp.cw_mul(w, depth)
                        for c in range(4, channels):
                            acc[c] += w * splat_floats[features + 4 + c]
                    acc[channels] = T
                    acc[channels + 1] = median
                    state[patch] = acc
            begin += size
            if opaque == 1:
                begin = pairs[1]
        for patch in range(patches):
            quad = first_quad(tile_x, tile_y, patch, quads)
            for c in range(planes):
                store_patch(image_quads, quad + c * plane, quads, state_quads, patch * held + c)
            store_patch(transmittance_quads, quad, quads, state_quads, patch * held + channels)
            store_patch(median_quads, quad, quads, state_quads, patch * held + channels + 1)

    return forward


KERNELS = {channels: _make(channels) for channels in (4, 20)}
"""By the number of channels."""
