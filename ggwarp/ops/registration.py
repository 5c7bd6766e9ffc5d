# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of torch tensors."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ggwarp.ops.tensors import as_matrices, as_quats, as_vectors, on_stream_of, warp_device
from ggwarp.solvers.registration import Cloud, Registration, RegistrationStage, build_target, register


def gicp(
    points: torch.Tensor,
    covariances: torch.Tensor,
    target_means: torch.Tensor,
    target_quats: torch.Tensor,
    target_scales: torch.Tensor,
    *,
    T_start: torch.Tensor | None = None,
    radii: Sequence[float] = (0.1, 0.03),
    iterations: int = 20,
    tolerance: float = 1e-5,
    robust_scale: float = 1e6,
) -> Registration:
    """Find T that lays ``points`` on a set of Gaussians: argmin sum rho(d^T (B + R A R^T)^-1 d), d = b - T a.

    Args:
        points: [n, 3] float32.
        covariances: [n, 3, 3] float32, A.
        target_means: [m, 3] float32, b.
        target_quats: [m, 4] float32, w first, with the scales B.
        target_scales: [m, 3] float32, standard deviations.
        T_start: [4, 4] where to start; None: the identity.
        radii: farthest match, coarse to fine, in the points' unit.
        iterations: linearisations per radius at most.
        tolerance: converged when a step is smaller, unit and radians.
        robust_scale: Geman-McClure's, Mahalanobis units; the default is plain least squares.

    Returns:
        The pose with its information matrix. The tensors (contiguous, on one device) are not copied.

    Raises:
        ValueError: a tensor of another shape, type or layout.
    """
    device = warp_device(points)
    start = torch.eye(4, dtype=torch.float64) if T_start is None else T_start.detach().double().cpu()
    cloud = Cloud(as_vectors(points, "points"), as_matrices(covariances, "covariances"))
    gaussians = (
        as_vectors(target_means, "target_means"),
        as_quats(target_quats, "target_quats"),
        as_vectors(target_scales, "target_scales"),
    )
    stages = [RegistrationStage(radius, iterations, tolerance, robust_scale) for radius in radii]
    with on_stream_of(points):
        # Matches lie within the last radius once the pose is near: such cells find them in few visits.
        target = build_target(*gaussians, cell_size=2.0 * radii[-1], device=device)
        return register(cloud, target, start.numpy(), stages, device=device)
