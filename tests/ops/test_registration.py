# SPDX-License-Identifier: Apache-2.0
"""Registration on torch tensors."""

import numpy as np
import torch

from benchmarking.inputs.walls import walls
from ggwarp.geometry import se3
from ggwarp.ops import gicp


def test_gicp_recovers_a_motion(rng, device):
    means, target_quats = (x.astype(np.float32) for x in walls(rng, 4000))
    T = se3.se3_exp([0.03, -0.02, 0.04, 0.02, 0.01, -0.03])
    world, quats = (x.astype(np.float32) for x in walls(rng, 1500))
    points = ((world - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    scales = np.tile(np.float32([1.0, 1.0, 0.001]), (4000, 1))
    normals = np.array([se3.matrix_from_quat(q) for q in quats])
    axes = T[:3, :3].T @ normals * [1.0, 1.0, 0.001]
    covariances = (axes @ axes.transpose(0, 2, 1)).astype(np.float32)
    tensors = [torch.from_numpy(x).to(device) for x in (points, covariances, means, target_quats, scales)]
    result = gicp(*tensors, radii=(0.3, 0.1))
    assert result.converged and result.matched > 1000
    np.testing.assert_allclose(result.T_wc, T, atol=1e-5)
