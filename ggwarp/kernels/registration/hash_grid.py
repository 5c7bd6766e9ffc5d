# SPDX-License-Identifier: Apache-2.0
"""A hash grid over points: build, exact nearest point within a radius; k nearest are in ``k_nearest``.

A point's key is a hash of its integer cell. Points are gathered into key order, so that a
cell's points are contiguous in memory; two cells that share a key are told apart by the true
cell kept with each point. Searches grow ring by ring around the query's cell and skip
every cell whose box is farther than what is already found, so they are exact for any cell
size; cost follows the points per cell (keep it under 16).
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

_CELL_LIMIT = wp.constant(1.0e9)


@wp.struct
class HashGrid:
    """Points in cell order. ``points[i]`` was given as point ``indices[i]``.

    Those of key ``h`` are ``spans[h, 0]`` to before ``spans[h, 1]``: side by side, for one access to memory.
    """

    count: int
    cell_size: float
    table_size: int
    points: wp.array[wp.vec3]
    cells: wp.array[wp.vec3i]
    indices: wp.array[int]
    keys: wp.array[int]
    spans: wp.array2d[int]


def allocate_hash_grid(capacity: int, *, device: Any) -> Any:
    """Return a :class:`HashGrid` with room for ``capacity`` points, for :func:`build_hash_grid`."""
    grid = HashGrid()
    capacity = max(capacity, 1)
    grid.table_size = 1 << max(4, (2 * capacity - 1).bit_length())
    grid.points = wp.empty(capacity, dtype=wp.vec3, device=device)
    grid.cells = wp.empty(capacity, dtype=wp.vec3i, device=device)
    # Twice the room: the radix sort ping-pongs inside its arrays.
    grid.indices = wp.empty(2 * capacity, dtype=int, device=device)
    grid.keys = wp.empty(2 * capacity, dtype=int, device=device)
    grid.spans = wp.empty((grid.table_size, 2), dtype=int, device=device)
    return grid


@wp.func
def cell_of(p: wp.vec3, cell_size: float) -> wp.vec3i:
    """Integer cell of a point; coordinates beyond the integers end in the outermost cell."""
    q = p / cell_size
    return wp.vec3i(
        int(wp.clamp(wp.floor(q[0]), -_CELL_LIMIT, _CELL_LIMIT)),
        int(wp.clamp(wp.floor(q[1]), -_CELL_LIMIT, _CELL_LIMIT)),
        int(wp.clamp(wp.floor(q[2]), -_CELL_LIMIT, _CELL_LIMIT)),
    )


@wp.func
def hash_cell(cell: wp.vec3i, table_size: int) -> int:
    h = cell[0] * 73856093 ^ cell[1] * 19349663 ^ cell[2] * 83492791
    h = h ^ (h >> 15)
    return h & (table_size - 1)


@wp.kernel
def _hash_points(
    offset: int,
    points: wp.array[wp.vec3],
    cell_size: float,
    table_size: int,
    keys: wp.array[int],
    indices: wp.array[int],
):
    i = offset + wp.tid()
    keys[i] = hash_cell(cell_of(points[i], cell_size), table_size)
    indices[i] = i


@wp.kernel
def _gather_points(points: wp.array[wp.vec3], grid: HashGrid):
    i = wp.tid()
    p = points[grid.indices[i]]
    grid.points[i] = p
    grid.cells[i] = cell_of(p, grid.cell_size)
    key = grid.keys[i]
    if i == 0 or grid.keys[i - 1] != key:
        grid.spans[key, 0] = i
    if i == grid.count - 1 or grid.keys[i + 1] != key:
        grid.spans[key, 1] = i + 1


def build_hash_grid(grid: Any, points: Any, *, cell_size: float, device: Any) -> None:
    """Fill ``grid`` with ``points``.

    Args:
        grid: from :func:`allocate_hash_grid`, with room for all points.
        points: [n] wp.vec3, finite.
        cell_size: edge of a cell, in the points' unit.

    Raises:
        ValueError: more points than the grid has room for, or a cell size that is not positive.
    """
    n = points.shape[0]
    if n > grid.points.shape[0]:
        raise ValueError(f"hash grid: {n} points, but room for {grid.points.shape[0]}")
    if not cell_size > 0.0:
        raise ValueError(f"hash grid: cell size {cell_size}, but it must be positive")
    grid.count = n
    grid.cell_size = cell_size
    grid.spans.zero_()
    if n == 0:
        return
    launch_split(
        _hash_points,
        n,
        inputs=[points, cell_size, grid.table_size],
        outputs=[grid.keys, grid.indices],
        device=device,
        min_piece=4096,
    )
    wp.utils.radix_sort_pairs(grid.keys, grid.indices, n)
    wp.launch(_gather_points, dim=n, inputs=[points, grid], device=device)


@wp.func
def gap2(q: float, cell: int, cell_size: float) -> float:
    """Squared distance from ``q`` to a cell along one axis, a little under the true one."""
    low = float(cell) * cell_size
    gap = wp.max(low - q, q - (low + cell_size))
    # A point's cell is computed in floats: allow for the rounding of large coordinates.
    gap = wp.max(gap - 4.0e-7 * wp.abs(q) - 1.0e-6 * cell_size, 0.0)
    return gap * gap


@wp.func
def _nearer_side(q: float, cell: int, cell_size: float) -> int:
    return wp.where(q - float(cell) * cell_size < 0.5 * cell_size, -1, 1)


@wp.func
def _next(step: int, side: int) -> int:
    """The step after ``step`` in 0, s, -s, 2s, -2s ... with s the nearer ``side``."""
    return wp.where(step * side > 0, -step, side - step)


@wp.func
def nearest_in_grid(grid: HashGrid, q: wp.vec3, radius: float):
    """Nearest point to ``q`` within ``radius``: (its place in the grid's order or -1, squared distance).

    Of equally near points the one given first wins.
    """
    best, best_d2, _others2 = nearest_and_others(grid, q, radius, 0.0)
    return best, best_d2


@wp.func
def nearest_and_others(grid: HashGrid, q: wp.vec3, radius: float, slack: float):
    """Return what :func:`nearest_in_grid` does, and the squared distance that all other points have at least.

    Those up to ``slack`` farther than the nearest are looked for; none is farther than ``radius`` then.
    """
    best = int(-1)
    best_d2 = radius * radius
    others2 = best_d2  # at least so far, as far as has been seen
    limit2 = best_d2  # nothing farther is looked for
    size = grid.cell_size
    home = cell_of(q, size)
    # From the near side to the far one: most cells are then farther than what is found.
    side_x = _nearer_side(q[0], home[0], size)
    side_y = _nearer_side(q[1], home[1], size)
    side_z = _nearer_side(q[2], home[2], size)
    rings = int(wp.ceil(radius / size))
    for ring in range(rings + 1):
        reach = wp.max(float(ring - 1), 0.0) * size  # this ring is at least so far away
        if reach * reach > limit2:
            break
        dz = int(0)
        for _z in range(2 * ring + 1):
            z2 = gap2(q[2], home[2] + dz, size)
            if z2 <= limit2:
                dy = int(0)
                for _y in range(2 * ring + 1):
                    yz2 = z2 + gap2(q[1], home[1] + dy, size)
                    if yz2 <= limit2:
                        # Inside the shell only its two walls are new.
                        shell = wp.abs(dz) == ring or wp.abs(dy) == ring
                        dx = wp.where(shell, 0, ring * side_x)
                        for _x in range(wp.where(shell, 2 * ring + 1, 2)):
                            if yz2 + gap2(q[0], home[0] + dx, size) <= limit2:
                                key = hash_cell(home + wp.vec3i(dx, dy, dz), grid.table_size)
                                # A point of another cell with this key is as good: no need to tell.
                                for j in range(grid.spans[key, 0], grid.spans[key, 1]):
                                    d2 = wp.length_sq(grid.points[j] - q)
                                    if d2 <= limit2 and j != best:
                                        nearer = d2 < best_d2 or (d2 == best_d2 and best < 0)
                                        if d2 == best_d2 and best >= 0:
                                            nearer = grid.indices[j] < grid.indices[best]
                                        if nearer:
                                            others2 = wp.where(best < 0, others2, wp.min(others2, best_d2))
                                            best = j
                                            best_d2 = d2
                                            farthest = wp.sqrt(d2) + slack
                                            limit2 = wp.min(limit2, farthest * farthest)
                                        else:
                                            others2 = wp.min(others2, d2)
                            dx = wp.where(shell, _next(dx, side_x), -dx)
                    dy = _next(dy, side_y)
            dz = _next(dz, side_z)
    return best, best_d2, wp.min(others2, limit2)


@wp.kernel
def _nearest(
    offset: int,
    grid: HashGrid,
    queries: wp.array[wp.vec3],
    radius: float,
    indices: wp.array[int],
    distances2: wp.array[float],
):
    i = offset + wp.tid()
    j, d2 = nearest_in_grid(grid, queries[i], radius)
    indices[i] = -1
    distances2[i] = wp.inf
    if j >= 0:
        indices[i] = grid.indices[j]
        distances2[i] = d2


def find_nearest(
    grid: Any, queries: Any, *, radius: float, indices: Any, distances2: Any, device: Any
) -> None:
    """Find each query's nearest grid point within ``radius``.

    Args:
        grid: a built :class:`HashGrid`.
        queries: [m] wp.vec3.
        radius: metres (the points' unit); exact for any value.
        indices: [m] int, written: index of the point as given to the build, -1 for none.
        distances2: [m] float, written: squared distance, inf for none.
    """
    launch_split(
        _nearest,
        queries.shape[0],
        inputs=[grid, queries, radius],
        outputs=[indices, distances2],
        device=device,
    )
