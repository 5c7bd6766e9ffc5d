# SPDX-License-Identifier: Apache-2.0
"""Ellipses of neighbourhoods against NumPy's eigenvectors."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.registration.covariance import (
    build_covariances,
    estimate_covariances,
    normalise_scales,
    plane_scales,
)
from ggwarp.ops.reference.registration import ellipse


def estimate(points, neighbours, device="cpu"):
    points = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    neighbours = wp.array(np.asarray(neighbours, np.int32), dtype=int, device=device)
    n = points.shape[0]
    quats = wp.zeros(n, dtype=wp.vec4, device=device)
    scales = wp.zeros(n, dtype=wp.vec3, device=device)
    estimate_covariances(points, points, neighbours, quats=quats, scales=scales, device=device)
    return quats.numpy(), scales.numpy()


@pytest.mark.parametrize("size", [1e-3, 0.05, 10.0])
def test_random_neighbourhoods(rng, device, size):
    # 3 m from the origin, as in a camera frame: the moments must not cancel.
    n, k = 200, 10
    points = (rng.normal(size=(n, 3)) * size * [1.0, 0.7, 0.1] + [0.5, -1.0, 3.0]).astype(np.float32)
    neighbours = np.stack([rng.choice(n, k, replace=False) for _ in range(n)])
    quats, scales = estimate(points, neighbours, device)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-5)
    assert (quats[:, 0] >= 0.0).all() and (np.diff(scales, axis=1) <= 1e-7).all()
    for i in range(n):
        axes, expected = ellipse(points[neighbours[i]])
        np.testing.assert_allclose(scales[i], expected, rtol=2e-3, atol=2e-4 * expected[0])
        A = se3.matrix_from_quat(quats[i]) * scales[i]
        B = axes * expected
        np.testing.assert_allclose(A @ A.T, B @ B.T, atol=1e-3 * expected[0] ** 2)


def test_a_plane_has_no_thickness_and_its_normal(rng, device):
    normal = np.array([0.6, 0.0, 0.8])
    points = rng.normal(size=(50, 3)) * 0.05
    points -= np.outer(points @ normal, normal)
    quats, scales = estimate(points, np.tile(np.arange(50), (50, 1)), device)
    assert (scales[:, 2] < 1e-3 * scales[:, 0]).all()
    for q in quats:
        assert abs(se3.matrix_from_quat(q)[:, 2] @ normal) > 1 - 1e-6


@pytest.mark.parametrize("neighbours", [[[-1, -1, -1]], [[0, -1, -1]], [[0, 0, 0]]])
def test_too_few_neighbours_give_a_point(neighbours, device):
    quats, scales = estimate([[1.0, 2.0, 3.0]], neighbours, device)
    np.testing.assert_array_equal(scales, np.zeros((1, 3)))
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)


def test_no_points(device):
    quats, scales = estimate(np.zeros((0, 3)), np.zeros((0, 10)), device)
    assert quats.shape == (0, 4) and scales.shape == (0, 3)


def test_scales_are_divided_by_their_median(device):
    scales = np.float32(
        [[0.3, 0.1, 0.02], [0.01, 0.5, 0.04], [2.0, 2.0, 2.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    )
    out = wp.zeros(5, dtype=wp.vec3, device=device)
    normalise_scales(wp.array(scales, dtype=wp.vec3, device=device), out=out, device=device)
    expected = [[3.0, 1.0, 0.2], [0.25, 12.5, 1.0], [1, 1, 1], [1, 1, 1], [1, 1, 1]]
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("noise_share", [0.0, 0.5])
def test_a_point_is_as_free_along_its_surface_as_its_normal_is_sure(device, noise_share):
    spreads = np.float32([[0.03, 0.02, 0.0], [0.03, 0.02, 0.04], [0.0, 0.0, 0.0]])
    scales = wp.zeros(3, dtype=wp.vec3, device=device)
    plane_scales(
        wp.array(spreads, dtype=wp.vec3, device=device),
        noise=wp.array([0.003, 0.019, 0.003], dtype=float, device=device),
        noise_share=noise_share,
        neighbours=9,
        slip=0.5,
        scales=scales,
        device=device,
    )
    noise = np.array([0.003, 0.019, 0.003])
    across = np.hypot(noise, spreads[:, 2])
    tilt = noise_share * noise[:, None] / np.sqrt(9.0) / np.maximum(spreads[:, :2], 1e-12)
    along = np.clip(across[:, None] / np.maximum(tilt, 1e-12), across[:, None], 0.5)
    if noise_share == 0.0:
        along[2] = across[2]  # a single point has no surface
    np.testing.assert_allclose(scales.numpy(), np.column_stack([along, across]), rtol=1e-5)


@pytest.mark.parametrize("order", [None, [2, 0, 1]])
def test_ellipses_multiplied_out(rng, device, order):
    quats = rng.normal(size=(3, 4)).astype(np.float32)
    scales = rng.uniform(0.01, 1.0, (3, 3)).astype(np.float32)
    covariances = wp.zeros(3, dtype=wp.mat33, device=device)
    build_covariances(
        wp.array(quats, dtype=wp.vec4, device=device),
        wp.array(scales, dtype=wp.vec3, device=device),
        order=None if order is None else wp.array(order, dtype=int, device=device),
        covariances=covariances,
        device=device,
    )
    A = np.array([se3.matrix_from_quat(q) * s for q, s in zip(quats, scales, strict=True)])
    expected = (A @ A.transpose(0, 2, 1))[range(3) if order is None else order]
    np.testing.assert_allclose(covariances.numpy(), expected, atol=1e-6)
