# SPDX-License-Identifier: Apache-2.0
"""Which splats fall on which tile, front to back.

Visible Gaussians are sorted by depth: rank r is the r-th nearest. Each (rank, tile) pair has a
*slot*; the slots of a rank are contiguous, so that gradients written per slot are summed per
Gaussian without atomics. Slots sorted stably by tile give each tile its splats in depth order.

On the CPU counts are read (memory is shared) and the second sort is a serial counting sort; on CUDA, and
while a graph is recorded, nothing is read back: slots up to the capacity are sorted, unused ones carry a
sentinel tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ggwarp.kernels.project import TILE
from ggwarp.kernels.tiles_parallel import OVERFLOW, PAIRS, VISIBLE, bin_in_parallel, tiles_of

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
        order: [2n] int: rank -> Gaussian for the first ``counts[0]`` entries; the rest is scratch.
        ranks: [n] int: Gaussian -> rank, -1 where it is not visible.
        slot_offsets: [n + 1] int: slots of rank r are slot_offsets[r] .. slot_offsets[r + 1].
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
def _gather_visible(
    tile_rects: wp.array[wp.vec4i],
    depths: wp.array[float],
    count: int,
    depth_keys: wp.array[float],
    visible: wp.array[int],
    order: wp.array[int],
    ranks: wp.array[int],
    counts: wp.array[int],
):
    """Serial, CPU only."""
    found = int(0)
    for i in range(count):
        rect = tile_rects[i]
        ranks[i] = -1
        if rect[2] > rect[0]:
            depth_keys[found] = depths[i]
            visible[found] = i
            order[found] = i
            found += 1
    counts[VISIBLE] = found


@wp.kernel
def _bin_serial(
    tile_rects: wp.array[wp.vec4i],
    order: wp.array[int],
    tiles_x: int,
    capacity: int,
    ranks: wp.array[int],
    slot_offsets: wp.array[int],
    slot_gaussians: wp.array[int],
    pair_slots: wp.array[int],
    tile_ranges: wp.array[wp.vec2i],
    counts: wp.array[int],
):
    """A counting sort by tile: serial, CPU only."""
    for t in range(tile_ranges.shape[0]):
        tile_ranges[t] = wp.vec2i(0, 0)
    pairs = wp.int64(0)
    for rank in range(counts[VISIBLE]):
        gaussian = order[rank]
        ranks[gaussian] = rank
        slot_offsets[rank] = int(pairs)
        pairs += wp.int64(tiles_of(tile_rects[gaussian]))
    slot_offsets[counts[VISIBLE]] = int(pairs)
    counts[PAIRS] = int(wp.min(pairs, wp.int64(2147483647)))
    counts[OVERFLOW] = 0
    if pairs > wp.int64(capacity):
        counts[OVERFLOW] = 1
        return
    for rank in range(counts[VISIBLE]):
        rect = tile_rects[order[rank]]
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                t = y * tiles_x + x
                tile_ranges[t] = tile_ranges[t] + wp.vec2i(0, 1)
    begin = int(0)
    for t in range(tile_ranges.shape[0]):
        size = tile_ranges[t][1]
        # The end is the cursor of the scatter below.
        tile_ranges[t] = wp.vec2i(begin, begin)
        begin += size
    slot = int(0)
    for rank in range(counts[VISIBLE]):
        gaussian = order[rank]
        rect = tile_rects[gaussian]
        for y in range(rect[1], rect[3]):
            for x in range(rect[0], rect[2]):
                t = y * tiles_x + x
                span = tile_ranges[t]
                pair_slots[span[1]] = slot
                tile_ranges[t] = wp.vec2i(span[0], span[1] + 1)
                slot_gaussians[slot] = gaussian
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
        tile_rects: [>= count] vec4i, see :class:`ggwarp.kernels.project.Splats`.
        depths: [>= count] metres; equal depths keep the Gaussians' order.
        count: rows in use.
        width, height: image size, pixels.
        out: allocated for this image size and at least ``count`` Gaussians.

    Raises:
        TileCapacityError: on the CPU, when there are too few slots; ``order`` and the number visible
            are right then. On CUDA and in a recording ``counts[2]`` is set instead and the farthest splats
            are left out.
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
        _gather_visible,
        dim=1,
        inputs=[tile_rects, depths, count],
        outputs=[out.depth_keys, out.visible, out.order, out.ranks, out.counts],
        device="cpu",
    )
    counts = out.counts.numpy()
    wp.utils.radix_sort_pairs(out.depth_keys, out.order, int(counts[0]))
    wp.launch(
        _bin_serial,
        dim=1,
        inputs=[tile_rects, out.order, tiles_x, out.capacity],
        outputs=[
            out.ranks,
            out.slot_offsets,
            out.slot_gaussians,
            out.pair_slots,
            out.tile_ranges,
            out.counts,
        ],
        device="cpu",
    )
    if counts[2]:
        raise TileCapacityError(int(counts[1]), out.capacity)
