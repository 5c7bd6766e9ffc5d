# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing in the form for a CPU: a task is a few tiles.

Patches are outermost: splats are taken in chunks, a chunk's splats are listed under the patches that
they touch, and then all channels of a patch stay in registers while its list is walked.
"""

import warp as wp

from ggwarp.kernels.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    TILES,
    TRANSMITTANCE_MIN,
    aligned,
    any_at_least,
    depth_at,
    log_alpha,
    make_exp,
    make_gather,
    make_listing,
    patch_x,
    patch_y,
)
from ggwarp.kernels.math import VECTOR_OPTIONS, vec16
from ggwarp.kernels.project import LOG_ALPHA_MIN

wp.set_module_options(VECTOR_OPTIONS)

CHUNK = 128
"""Splats that are listed at a time."""


def _make(channels: int):
    lines = 2 if channels == 20 else 1
    held = channels + 2
    patch_state = wp.types.matrix((held, 16), wp.float32)
    exp = make_exp()
    gather, list_splats = make_gather(lines, CHUNK), make_listing(lines, CHUNK)

    # Called once, so that LLVM inlines it.
    @wp.func
    def blend(
        count: int,
        head: int,
        patch: int,
        lists: wp.array[wp.int16],
        splats: wp.array[vec16],
        pixels: wp.array[vec16],
        state: wp.array[patch_state],
    ):
        """Pass the patch's splats front to back."""
        acc = state[patch]
        T = acc[channels]
        median = acc[channels + 1]
        pixel_x = pixels[patch]
        pixel_y = pixels[16 + patch]
        i = int(0)
        while i < count:
            k = int(lists[head + i]) * lines
            s = splats[k]
            dx = pixel_x - vec16(s[4])
            dy = pixel_y - vec16(s[5])
            power = log_alpha(s, dx, dy)
            alpha = wp.min(exp(power), vec16(ALPHA_MAX))
            depth = depth_at(s, dx, dy)
            w = vec16()
            for j in range(16):
                counted = power[j] >= LOG_ALPHA_MIN and T[j] >= TRANSMITTANCE_MIN
                w[j] = wp.where(counted, alpha[j] * T[j], 0.0)
                after = T[j] - w[j]
                median[j] = wp.where(T[j] >= 0.5 and after < 0.5, depth[j], median[j])
                T[j] = after
            for c in range(3):
                acc[c] += w * s[8 + c]
            acc[DEPTH] += wp.cw_mul(w, depth)
            if wp.static(lines == 2):
                f = splats[k + 1]
                for c in range(16):
                    acc[4 + c] += w * f[c]
            i += 1
        acc[channels] = T
        acc[channels + 1] = median
        state[patch] = acc

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
        # Strides that are known make short addresses.
        plane = image.shape[1] * tiles_x * 4
        image_quads = wp.array(ptr=image.ptr, shape=(channels * plane,), dtype=wp.vec4)
        transmittance_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
        median_quads = wp.array(ptr=median_depth.ptr, shape=(plane,), dtype=wp.vec4)
        slot_list = wp.array(ptr=pair_slots.ptr, shape=(pair_slots.shape[0],), dtype=int)
        gaussian_list = wp.array(ptr=slot_gaussians.ptr, shape=(slot_gaussians.shape[0],), dtype=int)
        row_lines = wp.array(ptr=rows.ptr, shape=(rows.shape[0],), dtype=vec16)
        identity_lines = wp.array(ptr=identities.ptr, shape=(identities.shape[0],), dtype=vec16)

        # Per patch: the channels, T and the median depth; the pixels' places.
        state_memory = wp.zeros(shape=wp.static(16 * held + 33), dtype=vec16)
        address = aligned(state_memory.ptr)
        state = wp.array(ptr=address, shape=(16,), dtype=patch_state)
        state_lines = wp.array(ptr=address, shape=(16 * held,), dtype=vec16)
        state_quads = wp.array(ptr=address, shape=(64 * held,), dtype=wp.vec4)
        pixels = wp.array(ptr=address + wp.static(wp.uint64(16 * 64 * held)), shape=(32,), dtype=vec16)
        splat_memory = wp.zeros(shape=wp.static(lines * CHUNK + 1), dtype=vec16)
        splats = wp.array(ptr=aligned(splat_memory.ptr), shape=(lines * CHUNK,), dtype=vec16)
        gaussian_memory = wp.zeros(shape=CHUNK, dtype=int)
        gaussians = wp.array(ptr=gaussian_memory.ptr, shape=(CHUNK,), dtype=int)
        list_memory = wp.zeros(shape=wp.static(16 * CHUNK), dtype=wp.int16)
        lists = wp.array(ptr=list_memory.ptr, shape=(16 * CHUNK,), dtype=wp.int16)
        count_memory = wp.zeros(shape=16, dtype=int)
        counts = wp.array(ptr=count_memory.ptr, shape=(16,), dtype=int)

        # A run-time number (see composite_patches).
        patches = wp.min(tiles_x, 0) + 16
        for patch in range(patches):
            pixels[patch] = patch_x(patch)
            pixels[16 + patch] = patch_y(patch)
        first_tile = (offset + wp.tid()) * TILES
        for tile in range(first_tile, wp.min(first_tile + TILES, tile_ranges.shape[0])):
            tile_y = tile // tiles_x
            tile_x = tile - tile_y * tiles_x
            for patch in range(patches):
                state[patch] = patch_state()
                state_lines[patch * held + channels] = vec16(1.0)
            pairs = tile_ranges[tile]
            begin = pairs[0]
            while begin < pairs[1]:
                size = wp.min(pairs[1] - begin, CHUNK)
                gather(size, slot_list, begin, gaussian_list, row_lines, identity_lines, gaussians, splats)
                list_splats(size, tile_x, tile_y, splats, counts, lists)
                opaque = int(1)
                for patch in range(patches):
                    if any_at_least(state_lines[patch * held + channels], TRANSMITTANCE_MIN):
                        opaque = 0
                        blend(counts[patch], patch * CHUNK, patch, lists, splats, pixels, state)
                begin += size
                if opaque == 1:
                    begin = pairs[1]
            for row in range(patches):
                at = ((tile_y * 16 + row) * tiles_x + tile_x) * 4
                source = (row & 12) * wp.static(4 * held) + (row & 3)
                for _ in range(4):
                    c = int(0)
                    while c < channels:
                        image_quads[at + c * plane] = state_quads[source + 4 * c]
                        c += 1
                    transmittance_quads[at] = state_quads[source + wp.static(4 * channels)]
                    median_quads[at] = state_quads[source + wp.static(4 * channels + 4)]
                    at += 1
                    source += wp.static(4 * held)

    return forward


KERNELS = {channels: _make(channels) for channels in (4, 20)}
"""By the number of channels."""
