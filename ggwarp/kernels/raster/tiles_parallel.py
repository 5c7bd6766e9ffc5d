# SPDX-License-Identifier: Apache-2.0
"""Tile binning as CUDA does it: every step parallel, no count read back (see ``raster.tiles``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

if TYPE_CHECKING:
    from ggwarp.kernels.raster.tiles import TileArrays

wp.set_module_options({"enable_backward": False})

VISIBLE = wp.constant(0)
PAIRS = wp.constant(1)
OVERFLOW = wp.constant(2)
PEAK = wp.constant(3)


@wp.func
def tiles_of(rect: wp.vec4i):
    return (rect[2] - rect[0]) * (rect[3] - rect[1])


@wp.kernel
def _flag_visible(tile_rects: wp.array[wp.vec4i], count: int, flags: wp.array[int]):
    i = wp.tid()
    flags[i] = 0
    if i < count:
        rect = tile_rects[i]
        flags[i] = wp.min(rect[2] - rect[0], 1)


@wp.kernel
def _depth_keys(
    depths: wp.array[float],
    flags: wp.array[int],
    places: wp.array[int],
    count: int,
    depth_keys: wp.array[float],
    visible: wp.array[int],
    order: wp.array[int],
    ranks: wp.array[int],
    counts: wp.array[int],
):
    i = wp.tid()
    if i == count:
        counts[VISIBLE] = places[count]
        return
    order[i] = i
    ranks[i] = -1
    # Culled ones go last.
    depth_keys[i] = wp.inf
    if flags[i] > 0:
        depth_keys[i] = depths[i]
        visible[places[i]] = i


@wp.kernel
def _count_pairs(
    tile_rects: wp.array[wp.vec4i],
    order: wp.array[int],
    counts: wp.array[int],
    ranks: wp.array[int],
    pair_counts: wp.array[int],
):
    rank = wp.tid()
    pair_counts[rank] = 0
    if rank < counts[VISIBLE]:
        gaussian = order[rank]
        ranks[gaussian] = rank
        pair_counts[rank] = tiles_of(tile_rects[gaussian])


@wp.kernel
def _emit_pairs(
    tile_rects: wp.array[wp.vec4i],
    order: wp.array[int],
    slot_offsets: wp.array[int],
    counts: wp.array[int],
    tiles_x: int,
    capacity: int,
    slot_gaussians: wp.array[int],
    pair_tiles: wp.array[int],
    pair_slots: wp.array[int],
):
    rank = wp.tid()
    if rank >= counts[VISIBLE]:
        return
    gaussian = order[rank]
    rect = tile_rects[gaussian]
    slot = slot_offsets[rank]
    for y in range(rect[1], rect[3]):
        for x in range(rect[0], rect[2]):
            if slot >= 0 and slot < capacity:
                pair_tiles[slot] = y * tiles_x + x
                pair_slots[slot] = slot
                slot_gaussians[slot] = gaussian
            slot += 1


@wp.func
def _first_not_below(tile: int, pair_tiles: wp.array[int], begin: int, end: int):
    low = begin
    high = end
    while low < high:
        middle = (low + high) / 2
        if pair_tiles[middle] < tile:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def _find_ranges(
    pair_tiles: wp.array[int],
    slot_offsets: wp.array[int],
    count: int,
    capacity: int,
    tile_ranges: wp.array[wp.vec2i],
    counts: wp.array[int],
):
    t = wp.tid()
    begin = _first_not_below(t, pair_tiles, 0, capacity)
    tile_ranges[t] = wp.vec2i(begin, _first_not_below(t + 1, pair_tiles, begin, capacity))
    if t == 0:
        pairs = slot_offsets[count]
        counts[PAIRS] = pairs
        counts[OVERFLOW] = 0
        if pairs < 0 or pairs > capacity:
            counts[OVERFLOW] = 1
        counts[PEAK] = wp.max(counts[PEAK], wp.where(pairs < 0, 2147483647, pairs))


def bin_in_parallel(
    tile_rects: wp.array, depths: wp.array, count: int, tiles_x: int, out: TileArrays
) -> None:
    """Do what ``raster.tiles.bin_splats`` does, on any device; overflow is only flagged."""
    device = tile_rects.device
    tile_count = out.tile_ranges.shape[0]
    # Before they count pairs these two hold the visible Gaussians' flags and places.
    sizes, offsets = out.pair_counts[: count + 1], out.slot_offsets[: count + 1]
    wp.launch(_flag_visible, dim=count + 1, inputs=[tile_rects, count], outputs=[sizes], device=device)
    wp.utils.array_scan(sizes, offsets, inclusive=False)
    wp.launch(
        _depth_keys,
        dim=count + 1,
        inputs=[depths, sizes, offsets, count],
        outputs=[out.depth_keys, out.visible, out.order, out.ranks, out.counts],
        device=device,
    )
    wp.utils.radix_sort_pairs(out.depth_keys, out.order, count)
    wp.launch(
        _count_pairs,
        dim=count + 1,
        inputs=[tile_rects, out.order, out.counts],
        outputs=[out.ranks, sizes],
        device=device,
    )
    wp.utils.array_scan(sizes, offsets, inclusive=False)
    out.pair_tiles.fill_(tile_count)
    wp.launch(
        _emit_pairs,
        dim=count,
        inputs=[tile_rects, out.order, offsets, out.counts, tiles_x, out.capacity],
        outputs=[out.slot_gaussians, out.pair_tiles, out.pair_slots],
        device=device,
    )
    wp.utils.radix_sort_pairs(out.pair_tiles, out.pair_slots, out.capacity, 0, (tile_count + 1).bit_length())
    wp.launch(
        _find_ranges,
        dim=tile_count,
        inputs=[out.pair_tiles, offsets, count, out.capacity],
        outputs=[out.tile_ranges, out.counts],
        device=device,
    )
