# SPDX-License-Identifier: Apache-2.0
"""Neighbour search on torch tensors."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.geometry import se3
from ggwarp.ops import knn
from ggwarp.ops.neighbours import ellipses
from ggwarp.ops.reference.registration import ellipse, k_nearest


@settings(max_examples=20)
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
