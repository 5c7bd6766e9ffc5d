# SPDX-License-Identifier: Apache-2.0
"""The exact k nearest points of a hash grid."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.registration.hash_grid import HashGrid, cell_of, gap2, hash_cell
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

_RINGS_BEFORE_SCAN = 4
"""Rings are given up after this many, and every point is looked at: only far outliers get there."""


@wp.func
def _box_distance2(q: wp.vec3, cell: wp.vec3i, cell_size: float) -> float:
    """Squared distance from ``q`` to a cell's box, a little under the true one."""
    return gap2(q[0], cell[0], cell_size) + gap2(q[1], cell[1], cell_size) + gap2(q[2], cell[2], cell_size)


@wp.func
def _offer(
    grid: HashGrid, j: int, q: wp.vec3, row: int, k: int, indices: wp.array2d[int], d2s: wp.array2d[float]
):
    """Insert grid point ``j`` into a row of the k nearest, sorted by (distance, given index)."""
    d2 = wp.length_sq(grid.points[j] - q)
    index = grid.indices[j]
    slot = int(k - 1)
    if d2 < d2s[row, slot] or (
        d2 == d2s[row, slot] and (indices[row, slot] < 0 or index < indices[row, slot])
    ):
        while slot > 0 and (
            d2 < d2s[row, slot - 1] or (d2 == d2s[row, slot - 1] and index < indices[row, slot - 1])
        ):
            d2s[row, slot] = d2s[row, slot - 1]
            indices[row, slot] = indices[row, slot - 1]
            slot -= 1
        d2s[row, slot] = d2
        indices[row, slot] = index


@wp.kernel
def _k_nearest(
    offset: int,
    grid: HashGrid,
    queries: wp.array[wp.vec3],
    k: int,
    rings: int,
    indices: wp.array2d[int],
    d2s: wp.array2d[float],
):
    i = offset + wp.tid()
    q = queries[i]
    for s in range(k):
        indices[i, s] = -1
        d2s[i, s] = wp.inf
    home = cell_of(q, grid.cell_size)
    done = bool(False)
    for ring in range(rings + 1):
        reach = wp.max(float(ring - 1), 0.0) * grid.cell_size
        if reach * reach > d2s[i, k - 1]:
            done = True
            break
        for dz in range(-ring, ring + 1):
            for dy in range(-ring, ring + 1):
                step = int(1)
                if wp.abs(dz) < ring and wp.abs(dy) < ring:
                    step = 2 * ring
                for dx in range(-ring, ring + 1, step):
                    cell = home + wp.vec3i(dx, dy, dz)
                    if _box_distance2(q, cell, grid.cell_size) <= d2s[i, k - 1]:
                        key = hash_cell(cell, grid.table_size)
                        for j in range(grid.spans[key, 0], grid.spans[key, 1]):
                            if grid.cells[j] == cell:
                                _offer(grid, j, q, i, k, indices, d2s)
    reach = float(rings) * grid.cell_size
    if not done and d2s[i, k - 1] > reach * reach:
        for s in range(k):
            indices[i, s] = -1
            d2s[i, s] = wp.inf
        for j in range(grid.count):
            _offer(grid, j, q, i, k, indices, d2s)


def find_k_nearest(grid: Any, queries: Any, *, k: int, indices: Any, distances2: Any, device: Any) -> None:
    """Find each query's ``k`` nearest grid points, nearest first.

    Args:
        grid: a built :class:`HashGrid`.
        queries: [m] wp.vec3; a query that is itself a grid point finds itself first.
        indices: [m, k] int, written: indices as given to the build; -1 where there are fewer points.
        distances2: [m, k] float, written: squared distances, inf where there are fewer points.
    """
    launch_split(
        _k_nearest,
        queries.shape[0],
        inputs=[grid, queries, k, _RINGS_BEFORE_SCAN],
        outputs=[indices, distances2],
        device=device,
    )
