# SPDX-License-Identifier: Apache-2.0
"""The adjoint of compositing in the form for a CPU: a task is a few tiles.

Patches are outermost, as in the forward form. With q_i = f_i . d_image and w_i = alpha_i T_i, the loss
changes with alpha_i by T_i q_i - R_i / (1 - alpha_i), where R_i is what the splats behind i and the
transmittance add to the loss: d_image . image + d_T T less the w q of the splats up to i. One scalar a
pixel, and no division by T.

A patch's list is walked several times, each time with what it needs in registers: the products q, lanes
being pixels; w and d loss / d ln alpha, front to back; then the sums over pixels, where lanes are
*gradients*: each pixel adds its row of d_image, or of the monomials 1, x, y, x^2, xy, y^2 that shape
gradients are made of, times one number. So nothing is ever summed across lanes.
"""

import warp as wp

from ggwarp.kernels.math import VECTOR_OPTIONS, vec16
from ggwarp.kernels.raster.composite_cpu_steps import (
    add_identities,
    add_identity_products,
    add_shapes,
    load_tile,
    mat4x16,
    mat16,
    mat16x8,
    take_products,
    turn_identities,
    turn_patch,
    walk,
)
from ggwarp.kernels.raster.composite_patches import (
    DEPTH,
    TILES,
    TRANSMITTANCE_MIN,
    aligned,
    any_at_least,
    gather_codes,
    gather_splats,
    list_splats,
    patch_x,
    patch_y,
    shape_gradients,
    vec8,
    vec16i,
)
from ggwarp.kernels.raster.sampling import in_sample

wp.set_module_options(VECTOR_OPTIONS)

CHUNK = 64
"""Splats that are listed at a time."""


def _bytes(lines: int) -> wp.uint64:
    return wp.uint64(64 * lines)


@wp.kernel(name="composite_cpu_adjoint")
def adjoint(
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
    d_image: wp.array3d[float],
    d_transmittance: wp.array2d[float],
    identity_shapes: int,
    slot_rows: wp.array[vec16],
    slot_identities: wp.array[vec16],
):
    # Strides that are known make short addresses.
    plane = image.shape[1] * tiles_x
    image_lines = wp.array(ptr=image.ptr, shape=(image.shape[0] * plane,), dtype=vec16)
    d_image_lines = wp.array(ptr=d_image.ptr, shape=(image.shape[0] * plane,), dtype=vec16)
    T_lines = wp.array(ptr=transmittance.ptr, shape=(plane,), dtype=vec16)
    d_T_lines = wp.array(ptr=d_transmittance.ptr, shape=(plane,), dtype=vec16)
    slot_list = wp.array(ptr=pair_slots.ptr, shape=(pair_slots.shape[0],), dtype=int)
    gaussian_list = wp.array(ptr=slot_gaussians.ptr, shape=(slot_gaussians.shape[0],), dtype=int)
    row_lines = wp.array(ptr=rows.ptr, shape=(rows.shape[0],), dtype=vec16)
    identity_lines = wp.array(ptr=identities.ptr, shape=(identities.shape[0],), dtype=vec16)
    slot_lines = wp.array(ptr=slot_rows.ptr, shape=(slot_rows.shape[0],), dtype=vec16)
    slot_identity_lines = wp.array(ptr=slot_identities.ptr, shape=(slot_rows.shape[0],), dtype=vec16)

    # Of a tile: gradients by patch and channel, and by pixel; the rows that w and d loss / d ln alpha
    # multiply; T, R and the pixels' places.
    memory = wp.zeros(shape=wp.static(16 * (4 + 20 + 32) + 2), dtype=vec16)
    address = aligned(memory.ptr)
    g = wp.array(ptr=address, shape=(16,), dtype=mat4x16)
    g_quads = wp.array(ptr=address, shape=(256,), dtype=wp.vec4)
    address += wp.static(_bytes(64))
    by_weight = wp.array(ptr=address, shape=(16,), dtype=mat16x8)
    weight_quads = wp.array(ptr=address, shape=(512,), dtype=wp.vec4)
    address += wp.static(_bytes(128))
    by_slope = wp.array(ptr=address, shape=(16,), dtype=mat16x8)
    slope_rows = wp.array(ptr=address, shape=(256,), dtype=vec8)
    address += wp.static(_bytes(128))
    transmittances = wp.array(ptr=address, shape=(16,), dtype=vec16)
    address += wp.static(_bytes(16))
    behind = wp.array(ptr=address, shape=(16,), dtype=vec16)
    behind_quads = wp.array(ptr=address, shape=(64,), dtype=wp.vec4)
    address += wp.static(_bytes(16))
    pixels = wp.array(ptr=address, shape=(32,), dtype=vec16)
    address += wp.static(_bytes(32))
    line = wp.array(ptr=address, shape=(1,), dtype=vec16)
    line_quads = wp.array(ptr=address, shape=(4,), dtype=wp.vec4)
    address += wp.static(_bytes(1))
    g_identity = wp.array(ptr=address, shape=(16,), dtype=mat16)
    g_identity_quads = wp.array(ptr=address, shape=(1024,), dtype=wp.vec4)
    address += wp.static(_bytes(256))
    turned = wp.array(ptr=address, shape=(16,), dtype=mat16)
    turned_quads = wp.array(ptr=address, shape=(1024,), dtype=wp.vec4)

    # Of a chunk: its splats, the sums over pixels, and per patch the list and what is found on the way.
    chunk_memory = wp.zeros(shape=wp.static(CHUNK * 7 + 1), dtype=vec16)
    address = aligned(chunk_memory.ptr)
    splats = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    codes = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    identity_sums = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    sums = wp.array(ptr=address, shape=(2 * CHUNK,), dtype=vec8)
    sum_lines = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    products = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    weights = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    address += wp.static(_bytes(CHUNK))
    slopes = wp.array(ptr=address, shape=(CHUNK,), dtype=vec16)
    slot_memory = wp.zeros(shape=CHUNK, dtype=int)
    slots = wp.array(ptr=slot_memory.ptr, shape=(CHUNK,), dtype=int)
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
        for lane in range(patches):
            u = float((patch & 3) * 4 + (lane & 3)) - 7.5
            v = float((patch >> 2) * 4 + (lane >> 2)) - 7.5
            slope_rows[patch * 16 + lane] = vec8(1.0, u, v, u * u, u * v, v * v, 0.0, 0.0)
    first_tile = (offset + wp.tid()) * TILES
    for tile in range(first_tile, wp.min(first_tile + TILES, tile_ranges.shape[0])):
        tile_y = tile // tiles_x
        tile_x = tile - tile_y * tiles_x
        with_identity = in_sample(tile_x, tile_y, stride, phase)
        load_tile(
            tile_y * 16 * tiles_x + tile_x,
            tiles_x,
            plane,
            with_identity,
            identity_shapes,
            image_lines,
            T_lines,
            d_image_lines,
            d_T_lines,
            g_quads,
            g_identity_quads,
            behind_quads,
            line,
            line_quads,
        )
        for patch in range(patches):
            transmittances[patch] = vec16(1.0)
            turn_patch(patch, g_quads, weight_quads)
            if with_identity:
                turn_identities(patch, g_identity_quads, turned_quads)
        pairs = tile_ranges[tile]
        begin = pairs[0]
        while begin < pairs[1]:
            size = wp.min(pairs[1] - begin, CHUNK)
            k = int(0)
            while k < size:
                slots[k] = slot_list[begin + k]
                sum_lines[k] = vec16()
                identity_sums[k] = vec16()
                k += 1
            gather_splats(size, slots, 0, gaussian_list, row_lines, gaussians, splats)
            if with_identity:
                gather_codes(size, gaussians, identity_lines, codes)
            list_splats(size, CHUNK, tile_x, tile_y, splats, counts, lists)
            for patch in range(patches):
                count = counts[patch]
                if count > 0 and any_at_least(transmittances[patch], TRANSMITTANCE_MIN):
                    head = patch * CHUNK
                    gp = g[patch]
                    take_products(count, head, lists, splats, gp, products)
                    if with_identity and identity_shapes != 0:
                        add_identity_products(count, head, lists, codes, g_identity[patch], products)
                    walk(
                        count,
                        head,
                        patch,
                        lists,
                        splats,
                        gp[DEPTH],
                        products,
                        pixels,
                        transmittances,
                        behind,
                        weights,
                        slopes,
                    )
                    if with_identity:
                        add_identities(count, head, lists, weights, turned[patch], identity_sums)
                    add_shapes(count, head, lists, weights, slopes, by_weight[patch], by_slope[patch], sums)
            k = int(0)
            while k < size:
                s = splats[k]
                geometry = vec8(s[0], s[1], s[2], s[4], s[5], s[6], s[7], s[3])
                slot_lines[slots[k]] = shape_gradients(geometry, sums[2 * k], sums[2 * k + 1])
                if stride > 0:
                    slot_identity_lines[slots[k]] = identity_sums[k]
                k += 1
            begin += size
