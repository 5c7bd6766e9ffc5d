# SPDX-License-Identifier: Apache-2.0
"""Gaussians counted on the surface that a view shows, against float64 loops."""

from __future__ import annotations

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.seeding.surface_count import count_on_surface, mean_over_surface

CAMERA = Camera(24, 18, 22.0, 21.0, 11.0, 8.5)
TOLERANCE = 0.03
T_CW = se3.se3_exp(np.array([0.1, -0.05, 0.2, 0.03, -0.02, 0.05]))


def two_surfaces(rng: np.random.Generator) -> np.ndarray:
    """Depth of a wall with something in front, and with holes."""
    depth = 2.0 + 0.01 * rng.normal(size=(CAMERA.height, CAMERA.width))
    depth[5:12, 8:15] -= 0.9
    depth[rng.random(depth.shape) < 0.1] = 0.0
    return depth.astype(np.float32)


def gaussians(rng: np.random.Generator, depth: np.ndarray, n: int = 600) -> np.ndarray:
    """Means [n, 3] round the view, most of them on a surface."""
    u, v = rng.uniform(-4, CAMERA.width + 4, n), rng.uniform(-4, CAMERA.height + 4, n)
    rows = np.clip(np.rint(v), 0, CAMERA.height - 1).astype(int)
    columns = np.clip(np.rint(u), 0, CAMERA.width - 1).astype(int)
    z = depth[rows, columns] * rng.choice([0.9, 0.99, 1.0, 1.01, 1.1, -1.0], n)
    p = np.stack([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=1)
    means = (p - T_CW[:3, 3]) @ T_CW[:3, :3]
    means[0], means[1] = np.nan, 1e30
    return means.astype(np.float32)


def reference_counts(means: np.ndarray, depth: np.ndarray) -> np.ndarray:
    counts = np.zeros(depth.shape, np.int32)
    for p in means.astype(np.float64) @ T_CW[:3, :3].T + T_CW[:3, 3]:
        if not (np.isfinite(p).all() and p[2] > 0.05):
            continue
        column = int(np.floor(CAMERA.fx * p[0] / p[2] + CAMERA.cx + 0.5))
        row = int(np.floor(CAMERA.fy * p[1] / p[2] + CAMERA.cy + 0.5))
        if not (0 <= row < CAMERA.height and 0 <= column < CAMERA.width):
            continue
        near = [
            (abs(p[2] - depth[y, x]), y, x)
            for y in range(max(row - 1, 0), min(row + 2, CAMERA.height))
            for x in range(max(column - 1, 0), min(column + 2, CAMERA.width))
            if depth[y, x] > 0.0
        ]
        if near and min(near)[0] <= TOLERANCE * p[2]:
            counts[min(near)[1:]] += 1
    return counts


def counted(means: np.ndarray, depth: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts [h, w] and their means over each pixel's surface [h, w]."""
    surface = wp.array(depth, dtype=float, device=device)
    counts = wp.full(depth.shape, 77, dtype=int, device=device)
    density = wp.full(depth.shape, 77.0, dtype=float, device=device)
    count_on_surface(
        wp.array(means, dtype=wp.vec3, device=device),
        count=len(means),
        T_cw=wp.array(T_CW.astype(np.float32)[None], dtype=wp.mat44, device=device),
        camera=intrinsics_of(CAMERA),
        depth=surface,
        tolerance=TOLERANCE,
        counts=counts,
        device=device,
    )
    mean_over_surface(counts, depth=surface, radius=2, tolerance=TOLERANCE, density=density, device=device)
    return counts.numpy(), density.numpy()


def test_each_counts_once_where_its_surface_is(rng: np.random.Generator, device: str) -> None:
    depth = two_surfaces(rng)
    means = gaussians(rng, depth)
    counts, _ = counted(means, depth, device)
    np.testing.assert_array_equal(counts, reference_counts(means, depth))
    assert 100 < counts.sum() < 400, "some on it, some in front, behind or outside"


def test_means_are_over_the_same_surface_alone(rng: np.random.Generator, device: str) -> None:
    depth = two_surfaces(rng)
    counts, density = counted(gaussians(rng, depth), depth, device)
    expected = np.zeros(depth.shape)
    for row, column in np.ndindex(*depth.shape):
        window = np.s_[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        own = depth[row, column].astype(np.float64)
        same = (np.abs(depth[window] - own) <= TOLERANCE * own) & (own > 0.0)
        expected[row, column] = counts[window][same].mean() if same.any() else 0.0
    np.testing.assert_allclose(density, expected, atol=1e-6)


def test_an_edge_gaussian_beside_its_surface_counts_there(device: str) -> None:
    depth = np.full((CAMERA.height, CAMERA.width), 3.0, np.float32)
    depth[:, :10] = 1.0
    p = np.array([(10.2 - CAMERA.cx) / CAMERA.fx, (9.0 - CAMERA.cy) / CAMERA.fy, 1.0])
    means = ((p - T_CW[:3, 3]) @ T_CW[:3, :3])[None].astype(np.float32)
    counts, density = counted(means, depth, device)
    assert counts.sum() == 1 and counts[8:11, 9].sum() == 1
    assert density[9, 8] > 0.0 and not density[:, 10:].any(), "it says nothing of what is behind"


def test_nothing_there(device: str) -> None:
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    for means, image in ((np.zeros((0, 3), np.float32), depth), (np.ones((5, 3), np.float32), 0 * depth)):
        counts, density = counted(means, image, device)
        assert not counts.any() and not density.any()
