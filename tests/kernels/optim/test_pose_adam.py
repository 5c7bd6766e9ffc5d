# SPDX-License-Identifier: Apache-2.0
"""Adam on a pose, against torch.optim.Adam on the twist and NumPy's exponential."""

import numpy as np
import torch
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.math import vec6
from ggwarp.kernels.optim.pose_adam import step_pose

RATES = (2e-3, 5e-3)


class Pose:
    def __init__(self, T_cw: np.ndarray, device: str) -> None:
        self.device = device
        self.T_cw = wp.array(T_cw[None].astype(np.float32), dtype=wp.mat44, device=device)
        self.moments = wp.zeros(2, dtype=vec6, device=device)
        self.steps = wp.zeros(1, dtype=wp.int32, device=device)

    def step(self, gradient: np.ndarray) -> np.ndarray:
        rows = wp.array(gradient[None].astype(np.float32), dtype=vec6, device=self.device)
        step_pose(
            rows, rates=RATES, moments=self.moments, steps=self.steps, T_cw=self.T_cw, device=self.device
        )
        return self.T_cw.numpy()[0].astype(np.float64)


def test_steps_are_adam_s(device: str, rng: np.random.Generator) -> None:
    T = se3.se3_exp(rng.normal(size=6))
    pose = Pose(T, device)
    # Adam's steps depend on its gradients alone: take them from an optimiser of the twist at zero.
    tau = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([tau], lr=1.0, eps=1e-15)
    for _ in range(20):
        gradient = rng.normal(size=6) * 10.0 ** rng.uniform(-6, 2)
        before = tau.detach().numpy().copy()
        tau.grad = torch.tensor(gradient)
        adam.step()
        step = (tau.detach().numpy() - before) * np.repeat(RATES, 3)
        T = se3.se3_exp(step) @ T
        np.testing.assert_allclose(pose.step(gradient), T, atol=5e-6)


def test_descends_to_the_target(device: str) -> None:
    """f(T) = |t(T) - t*|^2: the translation alone is asked for, and arrives."""
    pose = Pose(np.eye(4), device)
    target = np.array([0.05, -0.03, 0.02])
    T = np.eye(4)
    for _ in range(200):
        force = 2.0 * (T[:3, 3] - target)
        T = pose.step(np.r_[force, np.cross(T[:3, 3], force)])
    np.testing.assert_allclose(T[:3, 3], target, atol=5e-3)
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-6)


def test_a_gradient_that_is_not_finite_moves_nothing(device: str) -> None:
    pose = Pose(np.eye(4), device)
    for bad in (np.nan, np.inf):
        assert (pose.step(np.array([0, bad, 0, 0, 0, 0])) == np.eye(4)).all()
    assert pose.steps.numpy()[0] == 0


def test_no_gradient_moves_nothing(device: str) -> None:
    assert (Pose(np.eye(4), device).step(np.zeros(6)) == np.eye(4)).all()
