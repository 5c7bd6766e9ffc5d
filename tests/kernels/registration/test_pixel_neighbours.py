# SPDX-License-Identifier: Apache-2.0
"""The search around a pixel against brute force over all points."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.registration.pixel_neighbours import (
    MOST_NEIGHBOURS,
    find_k_nearest_pixels,
    normal_tilts,
    sample_grid,
)
from ggwarp.ops.reference.registration import k_nearest

H, W = 60, 84
V, U = np.mgrid[:H, :W]


def sampled(image, stride, intrinsics):
    """Return the points [n, 3] and pixels [n, 2] of an image's grid of samples."""
    fx, fy, cx, cy = intrinsics
    v, u = np.mgrid[stride // 2 : H : stride, stride // 2 : W : stride].reshape(2, -1)
    z = image[v, u]
    points = np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], axis=1).astype(np.float32)
    return points[z > 0], np.stack([u, v], axis=1)[z > 0]


def search(points, pixels, intrinsics, stride, k, device="cpu"):
    n = len(points)
    indices = wp.full((n, k), -7, dtype=int, device=device)
    find_k_nearest_pixels(
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(pixels.astype(np.int32), dtype=wp.vec2i, device=device),
        intrinsics,
        stride=stride,
        k=k,
        places=wp.empty(sample_grid(H, W, stride), dtype=int, device=device),
        indices=indices,
        device=device,
    )
    return indices.numpy()


def check(image, stride=3, k=10, intrinsics=(80.0, 75.0, 40.0, 31.0), device="cpu"):
    points, pixels = sampled(np.asarray(image, np.float64), stride, intrinsics)
    found = search(points, pixels, intrinsics, stride, k, device)
    expected_indices, expected = k_nearest(points, points, k)
    np.testing.assert_array_equal(found < 0, expected_indices < 0)
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in found)
    p = points.astype(np.float64)
    d2 = np.where(found >= 0, ((p[found] - p[:, None]) ** 2).sum(-1), np.inf)
    np.testing.assert_allclose(d2, expected, rtol=1e-5, atol=1e-12)


def test_a_wall(device):
    check(np.full((H, W), 2.0), device=device)


@pytest.mark.parametrize("slant", [0.05, 0.3, 0.55])
def test_a_slanted_wall(slant):
    # Nearly along the line of sight at the last: neighbours then lie many samples away.
    check(1.0 / (0.6 + slant * (U - 40.0) / 40.0))


@pytest.mark.parametrize(
    "intrinsics", [(80.0, 75.0, 40.0, 31.0), (20.0, 24.0, 5.0, 55.0), (300.0, 60.0, 90, -9)]
)
@pytest.mark.parametrize(("stride", "k"), [(1, 4), (2, 16), (5, 10), (7, 1)])
def test_steps_holes_and_noise(rng, intrinsics, stride, k):
    image = np.where(U > 50, 1.0, 3.0) + 0.5 * (V // 13 % 2) + rng.normal(size=(H, W)) * 0.02
    image[rng.random((H, W)) < 0.3] = 0.0
    image[20:35, 10:30] = 0.0
    check(image, stride, k, intrinsics)


def test_depth_without_any_surface(rng, device):
    check(rng.uniform(0.2, 8.0, (H, W)), device=device)


def test_a_speck_far_from_all_else():
    image = np.full((H, W), 6.0)
    image[31, 43] = 0.1
    check(image)


@pytest.mark.parametrize("readings", [0, 1, 5])
def test_fewer_points_than_neighbours(rng, readings, device):
    image = np.zeros((H, W))
    samples = rng.choice((H // 3) * (W // 3), readings, replace=False)
    image[1 + 3 * (samples // (W // 3)), 1 + 3 * (samples % (W // 3))] = rng.uniform(1.0, 4.0, readings)
    assert (image > 0).sum() == readings
    check(image, device=device)


def test_of_equally_near_points_the_first_wins():
    # A wall straight ahead, with coordinates that floats hold exactly.
    intrinsics = (64.0, 64.0, 0.0, 0.0)
    points, pixels = sampled(np.full((H, W), 2.0), 4, intrinsics)
    columns = sample_grid(H, W, 4)[1]
    at = 5 * columns + 8
    found = search(points, pixels, intrinsics, 4, 3)[at]
    np.testing.assert_array_equal(found, [at, at - columns, at - 1])


def test_too_many_neighbours_are_refused():
    points, pixels = sampled(np.ones((H, W)), 3, (80.0, 75.0, 40.0, 31.0))
    with pytest.raises(ValueError, match="k = 17, but it must be 1 to 16"):
        search(points, pixels, (80.0, 75.0, 40.0, 31.0), 3, MOST_NEIGHBOURS + 1)


def test_normals_are_compared_with_those_beside(rng, device):
    stride, apart, same, neighbours = 3, 4, 0.05, 10
    image = 2.0 + 0.3 * rng.random((H, W)) * (rng.random((H, W)) < 0.5)
    image[rng.random((H, W)) < 0.2] = 0.0
    points, pixels = sampled(image, stride, (80.0, 75.0, 40.0, 31.0))
    n = len(points)
    # Errors of normals of 1e-5 to 1e-1 radians: those of rendered depth are that small.
    axes = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-5, -1, size=(n, 1))
    quats = np.concatenate([np.ones((n, 1)), axes], axis=1).astype(np.float32)
    scales = -np.sort(-rng.uniform(0.001, 0.1, (n, 3))).astype(np.float32)
    deviations = rng.uniform(0.001, 0.02, n).astype(np.float32)
    places = np.full(sample_grid(H, W, stride), -1, np.int32)
    places[pixels[:, 1] // stride, pixels[:, 0] // stride] = np.arange(n)
    tilts = wp.full(n, 7.0, dtype=wp.float64, device=device)
    normal_tilts(
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(pixels.astype(np.int32), dtype=wp.vec2i, device=device),
        wp.array(places, dtype=int, device=device),
        stride=stride,
        apart=apart,
        same_surface=same,
        quats=wp.array(quats, dtype=wp.vec4, device=device),
        scales=wp.array(scales, dtype=wp.vec3, device=device),
        deviations=wp.array(deviations, dtype=float, device=device),
        neighbours=neighbours,
        tilts=tilts,
        device=device,
    )
    row, column = pixels[:, 1] // stride, pixels[:, 0] // stride + apart
    beside = np.where(column < places.shape[1], places[row, np.minimum(column, places.shape[1] - 1)], -1)
    z = points[:, 2]
    pairs = (beside >= 0) & (np.abs(z - z[beside]) < np.float32(same) * z)
    assert 50 < pairs.sum() < n - 50
    normals = se3.matrices_from_quats(quats)[:, :, 2]
    angles = np.arctan2(
        np.linalg.norm(np.cross(normals, normals[beside]), axis=1),
        np.abs((normals * normals[beside]).sum(axis=1)),
    )
    extents = np.sqrt(scales[:, 0].astype(np.float64) * scales[:, 1])
    expected = angles / (deviations / (np.sqrt(neighbours) * extents))
    np.testing.assert_allclose(tilts.numpy()[pairs], expected[pairs], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(tilts.numpy()[~pairs], -1.0)
