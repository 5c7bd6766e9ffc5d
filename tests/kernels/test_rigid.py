# SPDX-License-Identifier: Apache-2.0
"""Rigid motions on the device against those on the host."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.math import vec6d
from ggwarp.kernels.rigid import se3_exp, se3_log


@wp.kernel
def _logs(motions: wp.array[wp.mat44d], twists: wp.array[vec6d], back: wp.array[wp.mat44d]):
    i = wp.tid()
    twists[i] = se3_log(motions[i])
    back[i] = se3_exp(twists[i])


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 2.0, 3.1])
def test_a_motion_s_twist(device: str, rng: np.random.Generator, angle: float) -> None:
    axes = rng.normal(size=(50, 3))
    w = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    expected = np.concatenate([rng.normal(size=(50, 3)), w], axis=1)
    motions = wp.array(np.stack([se3.se3_exp(xi) for xi in expected]), dtype=wp.mat44d, device=device)
    twists = wp.zeros(50, dtype=vec6d, device=device)
    back = wp.zeros_like(motions)
    wp.launch(_logs, dim=50, inputs=[motions], outputs=[twists, back], device=device)
    np.testing.assert_allclose(twists.numpy(), expected, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(back.numpy(), motions.numpy(), rtol=1e-11, atol=1e-13)
