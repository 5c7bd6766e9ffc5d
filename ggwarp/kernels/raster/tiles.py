# SPDX-License-Identifier: Apache-2.0
"""Which splats fall on which tile, front to back.

Each pair of a visible Gaussian and a tile has a *slot*; the slots of a Gaussian are contiguous, so that
gradients written per slot are summed per Gaussian without atomics. Visible Gaussians are sorted by depth,
their pairs then stably by tile: each tile gets its splats in depth order.

On the CPU slots are numbered in the Gaussians' order, as neighbours in the map are neighbours in the image
and so in memory; counts are read (memory is shared) and the second sort is a serial counting sort. On
CUDA, and while a graph is recorded, slots are numbered by depth, so that a lack of them leaves out the
farthest, and nothing is read back: slots up to the capacity are sorted, unused ones carry a sentinel tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ggwarp.kernels.raster.project import TILE
from ggwarp.kernels.raster.tiles_parallel import OVERFLOW, PAIRS, VISIBLE, bin_in_parallel, tiles_of

wp.set_module_options({"enable_backward": False})


class TileCapacityError(RuntimeError):
    """More (splat, tile) pairs than slots.

    Attributes:
        needed: slots that would have been enough.
    """

    def __init__(self, needed: int, capacity: int) -> None:
        super().__init__(f"{needed} pairs of splats and tiles, but only {capacity} slots: allocate more")
        self.needed = needed


@dataclass(frozen=True)
class TileArrays:
    """The binning's results and scratch, for n Gaussians, P slots and t tiles.

    Attributes:
        visible: [n] int: the visible Gaussians, ascending, in the first ``counts[0]`` entries. Work that
            does not depend on depth goes in this order: it is several times kinder to caches.
        order: [2n] int: the visible Gaussians, front to back; the rest is scratch.
        ranks: [n] int: Gaussian -> its row r in ``slot_offsets``, -1 where it is not visible.
        slot_offsets: [n + 1] int: its slots are slot_offsets[r] .. slot_offsets[r + 1].
        slot_gaussians: [P] int: slot -> Gaussian.
        pair_slots: [2P] int: slots sorted by tile, then depth; the second half is scratch.
        tile_ranges: [t] vec2i: begin and end of each tile (row by row) in ``pair_slots``.
        counts: [4] int: visible Gaussians, pairs, whether the pairs exceed P; on CUDA also the most pairs
            of any binning since the array was allocated.
        depth_keys, pair_counts, pair_tiles: scratch: [2n] float, [n + 1] and [2P] int.
    """

    visible: wp.array
    order: wp.array
    ranks: wp.array
    slot_offsets: wp.array
    slot_gaussians: wp.array
    pair_slots: wp.array
    tile_ranges: wp.array
    counts: wp.array
    depth_keys: wp.array
    pair_counts: wp.array
    pair_tiles: wp.array

    @property
    def capacity(self) -> int:
        """Slots."""
        return self.slot_gaussians.shape[0]


def tiles_across(pixels: int) -> int:
    """Return how many tiles cover ``pixels``."""
    return -(-pixels // int(TILE))


@wp.kernel
def _number_slots(
    tile_rects: wp.array[wp.vec4i],
    depths: wp.array[float],
    count: int,
    tiles_x: int,
    depth_keys: wp.array[float],
    visible: wp.array[int],
    order: wp.array[int],
    ranks: wp.array[int],
    slot_offsets: wp.array[int],
    slot_gaussians: wp.array[int],
    tile_ranges: wp.array[wp.vec2i],
    counts: wp.array[int],
):
    """List the visible, give their pairs slots, and size the tiles: serial, CPU only."""
    for t in range(tile_ranges.shape[0]):
        tile_ranges[t] = wp.vec2i(0, 0)
    capacity = slot_gaussians.shape[0]
    found = int(0)
    slot = int(0)
    for i in range(count):
        rect = tile_rects[i]
        rank = int(-1)
        if rect[2] > rect[0]:
            rank = found
            depth_keys[found] = depths[i]
            visible[found] = i
            order[found] = i
            slot_offsets[found] = slot
            found += 1
            # A clamp, as a huge splat's pairs may not be countable.
            if slot <= 2147483647 - tiles_of(rect):
                for y in range(rect[1], rect[3]):
                    for x in range(rect[0], rect[2]):
                        if slot < capacity:
                            slot_gaussians[slot] = i
                        slot += 1
                        t = y * tiles_x + x
                        tile_ranges[t] = tile_ranges[t] + wp.vec2i(0, 1)
        ranks[i] = rank
    slot_offsets[found] = slot
    counts[VISIBLE] = found
    counts[PAIRS] = slot
    counts[OVERFLOW] = wp.where(slot > capacity, 1, 0)


@wp.kernel
def _scatter_pairs(
    tile_rects: wp.array[wp.vec4i],
    order: wp.array[int],
    ranks: wp.array[int],
    slot_offsets: wp.array[int],
    counts: wp.array[int],
    tiles_x: int,
    pair_slots: wp.array[int],
    tile_ranges: wp.array[wp.vec2i],
):
    """A counting sort by tile: serial, CPU only."""
    begin = int(0)
    for t in range(tile_ranges.shape[0]):
        size = tile_ranges[t][1]
        # The end is the cursor of the scatter below.
        tile_ranges[t] = wp.vec2i(begin, begin)
        begin += size
    for place in range(counts[VISIBLE]):
        gaussian = order[place]
        rect = tile_rects[gaussian]
        slot = slot_offsets[ranks[gaussian]]
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                t = y * tiles_x + x
                span = tile_ranges[t]
                pair_slots[span[1]] = slot
                tile_ranges[t] = wp.vec2i(span[0], span[1] + 1)
                slot += 1


def bin_splats(
    tile_rects: wp.array,
    depths: wp.array,
    *,
    count: int,
    width: int,
    height: int,
    out: TileArrays,
) -> None:
    """Sort the first ``count`` projected Gaussians by depth and into tiles.

    Args:
        tile_rects: [>= count] vec4i, see :class:`ggwarp.kernels.raster.project.Splats`.
        depths: [>= count] metres; equal depths keep the Gaussians' order.
        count: rows in use.
        width, height: image size, pixels.
        out: allocated for this image size and at least ``count`` Gaussians.

    Raises:
        TileCapacityError: on the CPU, when there are too few slots. On CUDA and in a recording
            ``counts[2]`` is set instead and the farthest splats are left out.
        ValueError: ``out`` is too small for ``count`` or made for another image size.
    """
    tiles_x, tiles_y = tiles_across(width), tiles_across(height)
    room, tile_room = out.slot_offsets.shape[0] - 1, out.tile_ranges.shape[0]
    if room < count or tile_room != tiles_x * tiles_y:
        raise ValueError(
            f"tile arrays hold {room} Gaussians and {tile_room} tiles, "
            f"but {count} and {tiles_x * tiles_y} are needed"
        )
    device = tile_rects.device
    if device.is_cpu and not device.is_capturing:
        _bin_on_cpu(tile_rects, depths, count, tiles_x, out)
    else:
        bin_in_parallel(tile_rects, depths, count, tiles_x, out)


def _bin_on_cpu(tile_rects: wp.array, depths: wp.array, count: int, tiles_x: int, out: TileArrays) -> None:
    wp.launch(
        _number_slots,
        dim=1,
        inputs=[tile_rects, depths, count, tiles_x],
        outputs=[
            *(out.depth_keys, out.visible, out.order, out.ranks, out.slot_offsets),
            *(out.slot_gaussians, out.tile_ranges, out.counts),
        ],
        device="cpu",
    )
    visible, pairs, overflow = out.counts.numpy()[:3].tolist()
    if overflow:
        raise TileCapacityError(pairs, out.capacity)
    wp.utils.radix_sort_pairs(out.depth_keys, out.order, visible)
    wp.launch(
        _scatter_pairs,
        dim=1,
        inputs=[tile_rects, out.order, out.ranks, out.slot_offsets, out.counts, tiles_x],
        outputs=[out.pair_slots, out.tile_ranges],
        device="cpu",
    )
