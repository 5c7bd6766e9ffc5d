# SPDX-License-Identifier: Apache-2.0
"""Neighbour search and registration on torch tensors."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.geometry import se3
from ggwarp.ops.gicp import gicp
from ggwarp.ops.knn import ellipses, knn
from ggwarp.ops.reference.registration import ellipse, k_nearest


@settings(max_examples=20, deadline=None)
@given(n=st.integers(0, 80), m=st.integers(0, 20), k=st.integers(1, 12), seed=st.integers(0, 2**16))
def test_knn_of_any_size(n, m, k, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)).astype(np.float32)
    queries = rng.normal(size=(m, 3)).astype(np.float32)
    indices, distances2 = knn(torch.from_numpy(points), torch.from_numpy(queries), k=k)
    expected_indices, expected = k_nearest(points, queries, k)
    np.testing.assert_array_equal(indices.numpy(), expected_indices)
    np.testing.assert_allclose(distances2.numpy(), expected, rtol=1e-5)


def test_duplicated_and_collinear_points(device):
    points = torch.zeros(30, 3, device=device)
    assert (knn(points, k=4)[1] == 0.0).all()
    points[:, 0] = torch.arange(30)
    indices, _ = knn(points, k=2)
    np.testing.assert_array_equal(indices[:, 0].cpu(), np.arange(30))


def test_ellipses(rng, device):
    points = (rng.normal(size=(200, 3)) * [1.0, 1.0, 0.02]).astype(np.float32)
    quats, scales = ellipses(torch.from_numpy(points).to(device), k=8)
    neighbours, _ = k_nearest(points, points, 8)
    for i in range(0, 200, 10):
        axes, expected = ellipse(points[neighbours[i]])
        np.testing.assert_allclose(scales[i].cpu(), expected, rtol=1e-3, atol=1e-5)
        assert abs(axes[:, 2] @ se3.matrix_from_quat(quats[i].cpu())[:, 2]) > 0.999


def corner(rng, n):
    """Points of three walls that meet, and their outward normals' ellipses."""
    wall = rng.integers(0, 3, n)
    points = rng.uniform(0.2, 2.0, (n, 3))
    points[np.arange(n), wall] = 0.0
    quats = np.array(
        [se3.quat_from_matrix(se3.so3_exp(w)) for w in ([0, np.pi / 2, 0], [np.pi / 2, 0, 0], [0, 0, 0])]
    )
    return points.astype(np.float32), quats[wall].astype(np.float32)


def test_gicp_recovers_a_motion(rng, device):
    means, target_quats = corner(rng, 4000)
    T = se3.se3_exp([0.03, -0.02, 0.04, 0.02, 0.01, -0.03])
    world, quats = corner(rng, 1500)
    points = ((world - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    scales = np.tile(np.float32([1.0, 1.0, 0.001]), (4000, 1))
    normals = np.array([se3.matrix_from_quat(q) for q in quats])
    axes = T[:3, :3].T @ normals * [1.0, 1.0, 0.001]
    covariances = (axes @ axes.transpose(0, 2, 1)).astype(np.float32)
    tensors = [torch.from_numpy(x).to(device) for x in (points, covariances, means, target_quats, scales)]
    result = gicp(*tensors, radii=(0.3, 0.1))
    assert result.converged and result.matched > 1000
    np.testing.assert_allclose(result.T_wc, T, atol=1e-5)


def test_tensors_are_not_copied_and_wrong_ones_are_refused():
    points = torch.rand(50, 3)
    with pytest.raises(ValueError, match="k = 0"):
        knn(points, k=0)
    with pytest.raises(ValueError, match=r"queries: shape \(50, 2\)"):
        knn(points, points[:, :2], k=1)
    with pytest.raises(ValueError, match=r"points: torch.float64"):
        knn(points.double(), k=1)
    with pytest.raises(ValueError, match="not contiguous"):
        knn(torch.rand(3, 50).T, k=1)
