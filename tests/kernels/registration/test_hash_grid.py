# SPDX-License-Identifier: Apache-2.0
"""The hash grid against brute force."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.registration.hash_grid import (
    HashGrid,
    allocate_hash_grid,
    build_hash_grid,
    find_nearest,
    hash_cell,
    nearest_and_others,
)
from ggwarp.kernels.registration.k_nearest import find_k_nearest
from ggwarp.ops.reference.registration import k_nearest


def build(points, cell_size, device="cpu", table_size=None):
    points = np.asarray(points, np.float32).reshape(-1, 3)
    grid = allocate_hash_grid(len(points), device=device)
    if table_size is not None:
        grid.table_size = table_size
    build_hash_grid(grid, wp.array(points, dtype=wp.vec3, device=device), cell_size=cell_size, device=device)
    return grid


def nearest(grid, queries, radius, device="cpu"):
    queries = np.asarray(queries, np.float32).reshape(-1, 3)
    indices = wp.zeros(len(queries), dtype=int, device=device)
    distances2 = wp.zeros(len(queries), dtype=float, device=device)
    find_nearest(
        grid,
        wp.array(queries, dtype=wp.vec3, device=device),
        radius=radius,
        indices=indices,
        distances2=distances2,
        device=device,
    )
    return indices.numpy(), distances2.numpy()


def k_near(grid, queries, k, device="cpu"):
    queries = np.asarray(queries, np.float32).reshape(-1, 3)
    indices = wp.zeros((len(queries), k), dtype=int, device=device)
    distances2 = wp.zeros((len(queries), k), dtype=float, device=device)
    find_k_nearest(
        grid,
        wp.array(queries, dtype=wp.vec3, device=device),
        k=k,
        indices=indices,
        distances2=distances2,
        device=device,
    )
    return indices.numpy(), distances2.numpy()


def check_nearest(points, queries, radius, cell_size, device="cpu", table_size=None):
    indices, distances2 = nearest(build(points, cell_size, device, table_size), queries, radius, device)
    _, expected = k_nearest(points, queries, 1)
    inside = expected[:, 0] < radius * radius * (1 - 1e-5)
    outside = expected[:, 0] > radius * radius * (1 + 1e-5)
    assert (indices[inside] >= 0).all()
    assert (indices[outside] == -1).all() and np.isinf(distances2[outside]).all()
    np.testing.assert_allclose(distances2[inside], expected[inside, 0], rtol=1e-5, atol=1e-12)
    found = indices[inside]
    exact = ((np.asarray(points, np.float64)[found] - np.asarray(queries, np.float64)[inside]) ** 2).sum(1)
    np.testing.assert_allclose(exact, expected[inside, 0], rtol=1e-5, atol=1e-12)


def check_k_nearest(points, queries, k, cell_size, device="cpu", table_size=None):
    indices, distances2 = k_near(build(points, cell_size, device, table_size), queries, k, device)
    expected_indices, expected = k_nearest(points, queries, k)
    np.testing.assert_array_equal(indices < 0, expected_indices < 0)
    np.testing.assert_allclose(distances2, expected, rtol=1e-5, atol=1e-12)
    for row in indices:
        kept = row[row >= 0]
        assert len(set(kept)) == len(kept)


@pytest.mark.parametrize("cell_size", [0.05, 0.3, 1.0, 50.0])
def test_random_points_around_the_origin(rng, device, cell_size):
    points = rng.normal(size=(600, 3)).astype(np.float32)
    queries = np.concatenate([points[:50], rng.normal(size=(100, 3)).astype(np.float32) * 1.5])
    check_nearest(points, queries, 0.2, cell_size, device)
    check_k_nearest(points, queries, 8, cell_size, device)


@wp.kernel
def _others(
    grid: HashGrid, queries: wp.array[wp.vec3], radius: float, slack: float, found: wp.array[wp.vec3]
):
    i = wp.tid()
    j, d2, others2 = nearest_and_others(grid, queries[i], radius, slack)
    found[i] = wp.vec3(float(j), d2, others2)


@pytest.mark.parametrize("slack", [0.0, 0.02, 0.1, 5.0])
@pytest.mark.parametrize("radius", [0.02, 0.3])
def test_all_other_points_are_at_least_so_far(rng, device, radius, slack):
    points = rng.uniform(size=(400, 3)).astype(np.float32)
    points[:40] = points[40:80]  # some are there twice
    queries = rng.uniform(-0.1, 1.1, size=(300, 3)).astype(np.float32)
    grid = build(points, 0.1, device)
    found = wp.zeros(len(queries), dtype=wp.vec3, device=device)
    on_device = wp.array(queries, dtype=wp.vec3, device=device)
    wp.launch(
        _others, dim=len(queries), inputs=[grid, on_device, radius, slack], outputs=[found], device=device
    )
    j, d2, others2 = found.numpy().T
    places, same = nearest(grid, queries, radius, device)
    order = grid.indices.numpy()
    np.testing.assert_array_equal(np.where(j < 0, -1, order[j.astype(int)]), places)
    np.testing.assert_array_equal(np.where(j < 0, np.inf, d2), same)
    two = np.sort(((queries[:, None].astype(np.float64) - points) ** 2).sum(axis=2), axis=1)[:, :2]
    second = np.where(j < 0, two[:, 0], two[:, 1])
    assert (others2 <= second * (1 + 1e-5) + 1e-12).all()
    looked = np.minimum(np.where(j < 0, radius, np.sqrt(two[:, 0]) + slack), radius) ** 2
    np.testing.assert_allclose(others2, np.minimum(second, looked), rtol=1e-5, atol=1e-12)


@settings(max_examples=25)
@given(
    n=st.integers(1, 60),
    m=st.integers(1, 10),
    k=st.integers(1, 12),
    cell_size=st.floats(0.02, 5.0),
    radius=st.floats(0.01, 3.0),
    seed=st.integers(0, 2**16),
)
def test_any_size(n, m, k, cell_size, radius, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n, 3)).astype(np.float32)
    queries = rng.uniform(-2, 2, (m, 3)).astype(np.float32)
    check_nearest(points, queries, radius, cell_size)
    check_k_nearest(points, queries, k, cell_size)


def test_no_points_and_no_queries(device):
    empty = np.zeros((0, 3), np.float32)
    indices, distances2 = nearest(build(empty, 0.1, device), [[0, 0, 0]], 1.0, device)
    assert indices[0] == -1 and np.isinf(distances2[0])
    assert (k_near(build(empty, 0.1, device), [[0, 0, 0]], 3, device)[0] == -1).all()
    assert nearest(build([[0, 0, 0]], 0.1, device), empty, 1.0, device)[0].shape == (0,)


def test_one_point(device):
    check_nearest(
        [[-0.3, 0.2, 5.0]], [[-0.3, 0.2, 5.0], [-0.3, 0.2, 5.05], [3.0, 3.0, 3.0]], 0.1, 0.02, device
    )
    check_k_nearest([[-0.3, 0.2, 5.0]], [[3.0, 3.0, 3.0]], 4, 0.02, device)


def test_duplicates_go_to_the_lowest_index(device):
    points = np.tile(np.float32([[0.1, -0.2, 0.3]]), (40, 1))
    grid = build(points, 0.05, device)
    indices, distances2 = nearest(grid, points[:1], 0.01, device)
    assert indices[0] == 0 and distances2[0] == 0.0
    np.testing.assert_array_equal(k_near(grid, points[:1], 5, device)[0][0], np.arange(5))


def test_far_outliers(rng, device):
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32)
    points[::50] = [
        [1e4, -2e4, 3e3],
        [-1e5, 7.0, 2.0],
        [50.0, 50.0, 50.0],
        [5e6, 0, 0],
        [-300, 1, 1],
        [0, 0, 9e4],
    ]
    check_nearest(points, points, 0.25, 0.1, device)
    check_k_nearest(points, points, 6, 0.1, device)


def test_cells_that_share_a_key_are_told_apart(rng, device):
    points = rng.uniform(-2, 2, (200, 3)).astype(np.float32)
    check_nearest(points, points + np.float32(0.01), 0.3, 0.2, device, table_size=2)
    check_k_nearest(points, points, 5, 0.2, device, table_size=2)


def test_non_finite_queries_find_nothing(device):
    grid = build(np.eye(3), 0.5, device)
    queries = np.float32([[np.nan, 0, 0], [np.inf, 0, 0], [1, 0, 0]])
    indices, _ = nearest(grid, queries, 0.5, device)
    np.testing.assert_array_equal(indices, [-1, -1, 0])


def test_the_hash_stays_in_the_table(rng):
    @wp.kernel(module="unique", enable_backward=False)
    def hash_cells(cells: wp.array[wp.vec3i], keys: wp.array[int]):
        i = wp.tid()
        keys[i] = hash_cell(cells[i], 64)

    cells = rng.integers(-(2**30), 2**30, (1000, 3)).astype(np.int32)
    keys = wp.zeros(1000, dtype=int, device="cpu")
    wp.launch(
        hash_cells, dim=1000, inputs=[wp.array(cells, dtype=wp.vec3i, device="cpu"), keys], device="cpu"
    )
    counts = np.bincount(keys.numpy(), minlength=64)
    assert counts.shape == (64,) and counts.max() < 50


def test_bad_arguments_are_refused(device):
    grid = allocate_hash_grid(2, device=device)
    points = wp.zeros(3, dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match="3 points, but room for 2"):
        build_hash_grid(grid, points, cell_size=0.1, device=device)
    with pytest.raises(ValueError, match="cell size 0"):
        build_hash_grid(grid, points[:2], cell_size=0.0, device=device)
