# SPDX-License-Identifier: Apache-2.0
"""Registration on torch tensors."""

import numpy as np
import torch

from ggwarp.geometry import se3
from ggwarp.ops import gicp


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
