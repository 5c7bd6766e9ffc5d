# SPDX-License-Identifier: Apache-2.0
"""The isotropic term's gradient against finite differences, on random and on round Gaussians."""

import numpy as np
import warp as wp

from ggwarp.kernels.losses.isotropy import pull_round


def gradient(log_scales: np.ndarray, ranks: np.ndarray, weight: float, device: str) -> np.ndarray:
    out = wp.ones(len(ranks), dtype=wp.vec3, device=device)
    pull_round(
        wp.array(log_scales.astype(np.float32), dtype=wp.vec3, device=device),
        ranks=wp.array(ranks, dtype=wp.int32, device=device),
        weight=weight,
        d_log_scales=out,
        device=device,
    )
    return out.numpy() - 1.0


def term(log_scales: np.ndarray) -> float:
    scales = np.exp(log_scales)
    return float(np.abs(scales - scales.mean(axis=1, keepdims=True)).mean(axis=1).sum())


def test_gradient_is_that_of_finite_differences(device: str, rng: np.random.Generator) -> None:
    log_scales = rng.normal(-1.0, 0.7, (200, 3))
    ranks = np.where(rng.random(200) < 0.7, np.arange(200), -1).astype(np.int32)
    got = gradient(log_scales, ranks, 3.0, device)
    for i in range(0, 200, 7):
        for k in range(3):
            step = np.zeros((200, 3))
            step[i, k] = 1e-6
            slope = (term(log_scales + step) - term(log_scales - step)) / 2e-6
            np.testing.assert_allclose(got[i, k], 3.0 * slope if ranks[i] >= 0 else 0.0, atol=2e-5)


def test_round_gaussians_are_left_alone(device: str) -> None:
    rounds = np.full((5, 3), -3.0)
    np.testing.assert_array_equal(gradient(rounds, np.zeros(5, np.int32), 10.0, device), 0.0)


def test_descent_makes_them_round(device: str, rng: np.random.Generator) -> None:
    log_scales = rng.normal(-1.0, 0.5, (50, 3))
    ranks = np.zeros(50, np.int32)
    before = term(log_scales)
    for _ in range(300):
        log_scales -= 0.02 * gradient(log_scales, ranks, 1.0, device)
    assert term(log_scales) < 0.1 * before
