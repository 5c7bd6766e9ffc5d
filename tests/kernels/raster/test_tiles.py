# SPDX-License-Identifier: Apache-2.0
"""Tile binning against brute force: one way on the CPU, another on CUDA, one result."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.raster.tiles import TileCapacityError, bin_splats, tiles_across
from ggwarp.kernels.raster.tiles_parallel import bin_in_parallel
from ggwarp.kernels.workspaces import allocate_tiles


def make_rects(rng, n, tiles_x, tiles_y, visible=0.7):
    x0, y0 = rng.integers(0, tiles_x, n), rng.integers(0, tiles_y, n)
    x1 = np.minimum(x0 + rng.integers(1, 4, n), tiles_x)
    y1 = np.minimum(y0 + rng.integers(1, 4, n), tiles_y)
    rects = np.stack([x0, y0, x1, y1], -1)
    rects[rng.random(n) > visible] = 0
    # Few distinct values: ties must keep the Gaussians' order.
    return rects.astype(np.int32), rng.choice([0.5, 1.0, 1.25, 3.0, 1e20], n).astype(np.float32)


def run_binning(rects, depths, width, height, slots, device, *, parallel=False):
    out = allocate_tiles(len(rects), slots, width=width, height=height, device=device)
    arrays = (wp.array(rects, dtype=wp.vec4i, device=device), wp.array(depths, dtype=float, device=device))
    if parallel:
        bin_in_parallel(*arrays, len(rects), tiles_across(width), out)
    else:
        bin_splats(*arrays, count=len(rects), width=width, height=height, out=out)
    return out


def brute_force(rects, depths, tiles_x, tile_count, *, by_depth):
    """Gaussians by depth and by rank, the Gaussian of each slot, the slots of each tile."""
    order = [i for i in np.argsort(depths, kind="stable") if rects[i, 2] > rects[i, 0]]
    numbered = order if by_depth else sorted(order)
    slots, first = [], {}
    for i in numbered:
        first[i] = len(slots)
        x0, y0, x1, y1 = rects[i]
        slots += [i] * ((x1 - x0) * (y1 - y0))
    tiles = [[] for _ in range(tile_count)]
    for i in order:
        x0, y0, x1, y1 = rects[i]
        for place, (y, x) in enumerate((y, x) for y in range(y0, y1) for x in range(x0, x1)):
            tiles[y * tiles_x + x].append(first[i] + place)
    return order, numbered, slots, tiles


def assert_binned(out, rects, depths, width, height, *, by_depth=None):
    """``by_depth``: how slots are numbered; on CUDA they are, on the CPU they are not."""
    if by_depth is None:
        by_depth = not out.order.device.is_cpu
    order, numbered, slots, tiles = brute_force(
        rects, depths, tiles_across(width), out.tile_ranges.shape[0], by_depth=by_depth
    )
    assert out.counts.numpy().tolist()[:3] == [len(order), len(slots), 0]
    assert out.order.numpy()[: len(order)].tolist() == order
    assert out.slot_gaussians.numpy()[: len(slots)].tolist() == slots
    assert out.visible.numpy()[: len(order)].tolist() == sorted(order)
    ranks = {gaussian: rank for rank, gaussian in enumerate(numbered)}
    assert out.ranks.numpy()[: len(rects)].tolist() == [ranks.get(i, -1) for i in range(len(rects))]
    offsets = out.slot_offsets.numpy()
    sizes = [(rects[i, 2] - rects[i, 0]) * (rects[i, 3] - rects[i, 1]) for i in numbered]
    assert offsets[: len(order) + 1].tolist() == np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist()
    pair_slots = out.pair_slots.numpy()
    for (begin, end), expected in zip(out.tile_ranges.numpy(), tiles, strict=True):
        assert pair_slots[begin:end].tolist() == expected


@pytest.mark.parametrize("parallel", [False, True], ids=["default", "as on CUDA"])
@settings(max_examples=25)
@given(
    n=st.integers(0, 60),
    width=st.integers(1, 100),
    height=st.integers(1, 70),
    seed=st.integers(0, 999),
    visible=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_tiles_list_their_splats_front_to_back(parallel, n, width, height, seed, visible):
    rects, depths = make_rects(
        np.random.default_rng(seed), n, tiles_across(width), tiles_across(height), visible
    )
    out = run_binning(rects, depths, width, height, 9 * n, "cpu", parallel=parallel)
    assert_binned(out, rects, depths, width, height, by_depth=parallel)


def test_many_splats(device, rng):
    rects, depths = make_rects(rng, 3000, 19, 11)
    out = run_binning(rects, depths, 300, 170, 30000, device)
    assert_binned(out, rects, depths, 300, 170)


def test_workspace_can_be_used_again_for_fewer(device, rng):
    rects, depths = make_rects(rng, 200, 4, 3)
    out = run_binning(rects, depths, 64, 48, 2000, device)
    few = rects[:50]
    arrays = (wp.array(rects, dtype=wp.vec4i, device=device), wp.array(depths, dtype=float, device=device))
    bin_splats(*arrays, count=50, width=64, height=48, out=out)
    assert_binned(out, few, depths[:50], 64, 48)


def test_cpu_names_the_slots_it_needs(rng):
    rects, depths = make_rects(rng, 50, 4, 3)
    needed = int(((rects[:, 2] - rects[:, 0]) * (rects[:, 3] - rects[:, 1])).sum())
    with pytest.raises(TileCapacityError) as error:
        run_binning(rects, depths, 64, 48, needed - 1, "cpu")
    assert error.value.needed == needed
    assert_binned(run_binning(rects, depths, 64, 48, needed, "cpu"), rects, depths, 64, 48)


def test_cuda_way_keeps_the_nearest_on_overflow(device, rng):
    rects, depths = make_rects(rng, 50, 4, 3)
    _, _, slots, tiles = brute_force(rects, depths, 4, 12, by_depth=True)
    room = len(slots) // 2
    out = run_binning(rects, depths, 64, 48, room, device, parallel=True)
    assert out.counts.numpy().tolist()[1:] == [len(slots), 1, len(slots)]
    pair_slots = out.pair_slots.numpy()
    for (begin, end), expected in zip(out.tile_ranges.numpy(), tiles, strict=True):
        assert pair_slots[begin:end].tolist() == [s for s in expected if s < room]


def test_wrong_workspace_is_refused(device, rng):
    rects, depths = make_rects(rng, 10, 4, 3)
    out = allocate_tiles(5, 100, width=64, height=48, device=device)
    arrays = (wp.array(rects, dtype=wp.vec4i, device=device), wp.array(depths, dtype=float, device=device))
    with pytest.raises(ValueError, match="hold 5 Gaussians"):
        bin_splats(*arrays, count=10, width=64, height=48, out=out)
    with pytest.raises(ValueError, match="12 tiles, but 5 and 1"):
        bin_splats(*arrays, count=5, width=16, height=16, out=out)
