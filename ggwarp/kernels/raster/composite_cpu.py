# SPDX-License-Identifier: Apache-2.0
"""Alpha compositing in the form for a CPU: a task is a few tiles.

Patches are outermost: splats are taken in chunks, a chunk's splats are listed under the patches that
they touch, and then all channels of a patch stay in registers while its list is walked: colour and depth,
and where identities are looked at, these by the weights found on the way.
"""

import warp as wp

from ggwarp.kernels.math import VECTOR_OPTIONS, vec16
from ggwarp.kernels.raster.composite_patches import (
    ALPHA_MAX,
    DEPTH,
    TILES,
    TRANSMITTANCE_MIN,
    aligned,
    any_at_least,
    depth_at,
    exp_in_range,
    gather_codes,
    gather_splats,
    list_splats,
    log_alpha,
    patch_x,
    patch_y,
    vec16i,
)
from ggwarp.kernels.raster.project import LOG_ALPHA_MIN
from ggwarp.kernels.raster.sampling import in_sample

wp.set_module_options(VECTOR_OPTIONS)

CHUNK = 128
"""Splats that are listed at a time."""


patch_state = wp.types.matrix((6, 16), wp.float32)
mat16 = wp.types.matrix((16, 16), wp.float32)


@wp.func
def _blend(
    count: int,
    head: int,
    patch: int,
    lists: wp.array[wp.int16],
    splats: wp.array[vec16],
    pixels: wp.array[vec16],
    state: wp.array[patch_state],
    weights: wp.array[vec16],
):
    """Pass the patch's splats front to back."""
    acc = state[patch]
    T = acc[4]
    median = acc[5]
    pixel_x = pixels[patch]
    pixel_y = pixels[16 + patch]
    i = int(0)
    while i < count:
        s = splats[int(lists[head + i])]
        dx = pixel_x - vec16(s[4])
        dy = pixel_y - vec16(s[5])
        power = log_alpha(s, dx, dy)
        alpha = wp.min(exp_in_range(power), vec16(ALPHA_MAX))
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
        weights[i] = w
        i += 1
    acc[4] = T
    acc[5] = median
    state[patch] = acc


@wp.func
def _blend_identities(
    count: int,
    head: int,
    patch: int,
    lists: wp.array[wp.int16],
    codes: wp.array[vec16],
    weights: wp.array[vec16],
    identity_state: wp.array[mat16],
):
    acc = identity_state[patch]
    i = int(0)
    while i < count:
        f = codes[int(lists[head + i])]
        w = weights[i]
        for c in range(16):
            acc[c] += w * f[c]
        i += 1
    identity_state[patch] = acc


@wp.kernel(name="composite_cpu")
def forward(
    offset: int,
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
    # Strides that are known make short addresses.
    plane = image.shape[1] * tiles_x * 4
    image_quads = wp.array(ptr=image.ptr, shape=(image.shape[0] * plane,), dtype=wp.vec4)
    transmittance_quads = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=wp.vec4)
    median_quads = wp.array(ptr=median_depth.ptr, shape=(plane,), dtype=wp.vec4)
    slot_list = wp.array(ptr=pair_slots.ptr, shape=(pair_slots.shape[0],), dtype=int)
    gaussian_list = wp.array(ptr=slot_gaussians.ptr, shape=(slot_gaussians.shape[0],), dtype=int)
    row_lines = wp.array(ptr=rows.ptr, shape=(rows.shape[0],), dtype=vec16)
    identity_lines = wp.array(ptr=identities.ptr, shape=(identities.shape[0],), dtype=vec16)

    # Per patch: the channels, T and the median depth; the pixels' places; identities.
    state_memory = wp.zeros(shape=wp.static(16 * 6 + 32 + 256 + 1), dtype=vec16)
    address = aligned(state_memory.ptr)
    state = wp.array(ptr=address, shape=(16,), dtype=patch_state)
    state_lines = wp.array(ptr=address, shape=(96,), dtype=vec16)
    state_quads = wp.array(ptr=address, shape=(384,), dtype=wp.vec4)
    address += wp.static(wp.uint64(64 * 96))
    pixels = wp.array(ptr=address, shape=(32,), dtype=vec16)
    address += wp.static(wp.uint64(64 * 32))
    identity_state = wp.array(ptr=address, shape=(16,), dtype=mat16)
    identity_quads = wp.array(ptr=address, shape=(1024,), dtype=wp.vec4)
    splat_memory = wp.zeros(shape=wp.static(3 * CHUNK + 1), dtype=vec16)
    address = aligned(splat_memory.ptr)
    splats = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(wp.uint64(64 * CHUNK))
    codes = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(wp.uint64(64 * CHUNK))
    weights = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    gaussian_memory = wp.zeros(shape=CHUNK, dtype=int)
    gaussians = wp.array(ptr=gaussian_memory.ptr, shape=(CHUNK,), dtype=int)
    list_memory = wp.zeros(shape=wp.static(16 * CHUNK), dtype=wp.int16)
    lists = wp.array(ptr=list_memory.ptr, shape=(16 * CHUNK,), dtype=wp.int16)
    count_memory = wp.zeros(shape=2, dtype=vec16i)
    counts = wp.array(ptr=aligned(count_memory.ptr), shape=(16,), dtype=int)

    # A run-time number (see composite_patches).
    patches = wp.min(tiles_x, 0) + 16
    for patch in range(patches):
        pixels[patch] = patch_x(patch)
        pixels[16 + patch] = patch_y(patch)
    first_tile = (offset + wp.tid()) * TILES
    for tile in range(first_tile, wp.min(first_tile + TILES, tile_ranges.shape[0])):
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        with_identity = in_sample(tile_x, tile_y, stride, phase)
        for patch in range(patches):
            state[patch] = patch_state()
            state_lines[patch * 6 + 4] = vec16(1.0)
            if with_identity:
                identity_state[patch] = mat16()
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            gather_splats(size, slot_list, begin, gaussian_list, row_lines, gaussians, splats)
            if with_identity:
                gather_codes(size, gaussians, identity_lines, codes)
            list_splats(size, CHUNK, tile_x, tile_y, splats, counts, lists)
            opaque = int(1)
            for patch in range(patches):
                if any_at_least(state_lines[patch * 6 + 4], TRANSMITTANCE_MIN):
                    opaque = 0
                    count = counts[patch]
                    head = patch * CHUNK
                    _blend(count, head, patch, lists, splats, pixels, state, weights)
                    if with_identity:
                        _blend_identities(count, head, patch, lists, codes, weights, identity_state)
            begin += size
            if opaque == 1:
                begin = pairs[1]
        for row in range(patches):
            at = ((tile_y * 16 + row) * tiles_x + tile_x) * 4
            source = (row & 12) * 24 + (row & 3)
            for _ in range(4):
                c = int(0)
                while c < 4:
                    image_quads[at + c * plane] = state_quads[source + 4 * c]
                    c += 1
                transmittance_quads[at] = state_quads[source + 16]
                median_quads[at] = state_quads[source + 20]
                at += 1
                source += 24
            if with_identity:
                at += 4 * plane - 4
                source = (row & 12) * 64 + (row & 3)
                for _ in range(4):
                    c = int(0)
                    while c < 16:
                        image_quads[at + c * plane] = identity_quads[source + 4 * c]
                        c += 1
                    at += 1
                    source += 64
