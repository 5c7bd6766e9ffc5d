# SPDX-License-Identifier: Apache-2.0
"""Three walls that meet, to register to: their points, their ellipses, and what a camera sees of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.solvers.registration import Cloud, RegistrationTarget, build_target
from ggwarp.types import Float64


def walls(rng: np.random.Generator, n: int) -> tuple[Float64, Float64]:
    """Return ``n`` points [n, 3] of the walls, and quaternions [n, 4] of ellipses that are flat on them."""
    wall = rng.integers(0, 3, n)
    points = rng.uniform(0.2, 2.0, (n, 3))
    points[np.arange(n), wall] = 0.0
    turns = ([0, np.pi / 2, 0], [np.pi / 2, 0, 0], [0, 0, 0])
    quats = np.array([se3.quat_from_matrix(se3.so3_exp(w)) for w in turns])
    return points, quats[wall]


def walls_target(rng: np.random.Generator, n: int, device: Any) -> RegistrationTarget:
    """Return ``n`` flat Gaussians on the walls."""
    points, quats = walls(rng, n)
    return build_target(
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(quats, dtype=wp.vec4, device=device),
        wp.full(n, wp.vec3(0.05, 0.05, 0.002), dtype=wp.vec3, device=device),
        cell_size=0.1,
        device=device,
    )


def walls_cloud(rng: np.random.Generator, n: int, T_wc: Float64, device: Any) -> Cloud:
    """Return ``n`` points of the walls in the frame of a camera at ``T_wc`` [4, 4]."""
    points = se3.transform_points(se3.inverse(T_wc), walls(rng, n)[0])
    covariance = wp.mat33(*(1e-5 * np.eye(3)).ravel())
    return Cloud(
        wp.array(points, dtype=wp.vec3, device=device),
        wp.full(n, covariance, dtype=wp.mat33, device=device),
    )
