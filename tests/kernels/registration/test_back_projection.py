# SPDX-License-Identifier: Apache-2.0
"""Sampling and back-projection against NumPy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.registration.back_projection import sample_depth, sample_grid

INTRINSICS = (50.0, 60.0, 15.5, 11.25)


def sample(depth, stride=1, edge=0.0, near=0.1, far=10.0, device="cpu"):
    depth = np.asarray(depth, np.float32)
    rows, columns = sample_grid(*depth.shape, stride)
    n = rows * columns
    flags, slots = (wp.zeros(n, dtype=int, device=device) for _ in range(2))
    points = wp.zeros(n, dtype=wp.vec3, device=device)
    pixels = wp.zeros(n, dtype=wp.vec2i, device=device)
    sample_depth(
        wp.array(depth, dtype=float, device=device),
        INTRINSICS,
        stride=stride,
        near=near,
        far=far,
        edge=edge,
        flags=flags,
        slots=slots,
        points=points,
        pixels=pixels,
        device=device,
    )
    count = int(flags.numpy()[-1] + slots.numpy()[-1]) if n else 0
    return points.numpy()[:count], pixels.numpy()[:count]


@settings(max_examples=20)
@given(h=st.integers(1, 30), w=st.integers(1, 30), stride=st.integers(1, 12), seed=st.integers(0, 999))
def test_points_are_the_back_projected_grid(h, w, stride, seed):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.05, 11.0, (h, w)).astype(np.float32)
    depth[rng.random((h, w)) < 0.2] = 0.0
    points, pixels = sample(depth, stride)
    v, u = np.mgrid[stride // 2 : h : stride, stride // 2 : w : stride]
    z = depth[v, u].astype(np.float64)
    keep = (z >= 0.1) & (z <= 10.0)
    u, v, z = u[keep], v[keep], z[keep]
    fx, fy, cx, cy = INTRINSICS
    np.testing.assert_array_equal(pixels, np.stack([u, v], 1))
    np.testing.assert_allclose(points, np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], 1), rtol=1e-5)


def test_what_is_not_a_reading_gives_no_point(device):
    depth = np.float32([[0.0, np.nan, np.inf], [-1.0, 0.05, 10.5], [1.0, 9.9, 0.1]])
    _, pixels = sample(depth, device=device)
    np.testing.assert_array_equal(pixels, [[0, 2], [1, 2], [2, 2]])


def test_a_slanted_wall_is_kept_and_a_step_is_dropped(device):
    fx, _, cx, _ = INTRINSICS
    u = np.arange(32.0)
    # The plane X + 0.6 Z = 2: inverse depth is linear in u.
    wall = np.tile(2.0 / ((u - cx) / fx + 0.6), (24, 1)).astype(np.float32)
    assert len(sample(wall, edge=0.005, device=device)[0]) == 30 * 22
    step = np.full((24, 32), 2.0, np.float32)
    step[:, 16:] = 2.2
    _, pixels = sample(step, edge=0.02, device=device)
    assert {15, 16}.isdisjoint(pixels[:, 0]) and {14, 17} <= set(pixels[:, 0])


def test_the_rim_of_a_hole_is_dropped(device):
    depth = np.full((24, 32), 2.0, np.float32)
    depth[10, 10] = 0.0
    _, pixels = sample(depth, edge=0.02, device=device)
    kept = {tuple(p) for p in pixels}
    assert kept.isdisjoint({(10, 10), (9, 10), (11, 10), (10, 9), (10, 11), (0, 5)}) and (9, 9) in kept


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_an_empty_image(shape, device):
    assert len(sample(np.zeros(shape, np.float32), device=device)[0]) == 0
