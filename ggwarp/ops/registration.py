# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of a frame's points to a map: the kernels of one registration, in their order.

Works on Warp arrays; :mod:`ggwarp.ops.gicp` is the same for torch tensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels import covariance, gicp, neighbours
from ggwarp.kernels.streams import to_host
from ggwarp.types import Float64


@dataclass(frozen=True)
class Cloud:
    """Points with covariances.

    Attributes:
        points: [n] wp.vec3, metres.
        covariances: [n] wp.mat33, m^2, in the points' frame.
    """

    points: Any
    covariances: Any

    @property
    def count(self) -> int:
        return self.points.shape[0]

    def thinned(self, step: int) -> Cloud:
        """Return every ``step``-th point, without a copy."""
        return Cloud(self.points[::step], self.covariances[::step])


@dataclass(frozen=True)
class Target:
    """A map to register to.

    Attributes:
        grid: built hash grid of the points, world frame.
        covariances: [n] wp.mat33, world frame, in the grid's order.
    """

    grid: Any
    covariances: Any

    @property
    def count(self) -> int:
        return self.grid.count


@dataclass(frozen=True)
class Stage:
    """Linearisations that share a correspondence radius.

    Attributes:
        radius: farthest match, metres.
        iterations: linearisations at most.
        tolerance: converged when a step is smaller, metres and radians.
        robust_scale: Geman-McClure's, standard deviations; the default is plain least squares.
        thinning: use every so-manyth point.
    """

    radius: float
    iterations: int
    tolerance: float
    robust_scale: float = 1e6
    thinning: int = 1


@dataclass(frozen=True)
class Registration:
    """Where a registration ended.

    Attributes:
        T_wc: [4, 4] float64.
        information: [6, 6] float64, H at the last linearisation: the inverse covariance of the pose in
            the camera, (translation, rotation), if the points' covariances are those of their noise.
        cost: robust cost there.
        matched: matched pairs there.
        converged: whether the last stage's last step was below its tolerance.
        iterations: linearisations in all.
    """

    T_wc: Float64
    information: Float64
    cost: float
    matched: int
    converged: bool
    iterations: int


def build_target(means: Any, quats: Any, scales: Any, *, cell_size: float, device: Any) -> Target:
    """Sort a map's ellipses into a grid.

    Args:
        means, quats, scales: [n] wp.vec3, wp.vec4 (w first), wp.vec3, world frame, metres.
        cell_size: metres.
    """
    n = means.shape[0]
    grid = neighbours.allocate_hash_grid(n, device=device)
    neighbours.build_hash_grid(grid, means, cell_size=cell_size, device=device)
    covariances = _empty(n, wp.mat33, device)
    covariance.build_covariances(quats, scales, order=grid.indices, covariances=covariances, device=device)
    return Target(grid, covariances)


def register(
    cloud: Cloud, target: Target, T_start: Float64, stages: list[Stage], *, device: Any
) -> Registration:
    """Find the pose that lays ``cloud`` on ``target``.

    Args:
        cloud: points and covariances, camera frame.
        T_start: [4, 4] camera-to-world, where to start.
        stages: coarse to fine.
    """
    pose = wp.array(np.asarray(T_start, np.float64)[None], dtype=wp.mat44d, device=device)
    step = wp.zeros(2, dtype=wp.float64, device=device)
    system = wp.zeros(gicp.SUMS, dtype=wp.float64, device=device)
    sums = _empty((max(1, gicp.block_count(cloud.count)), gicp.SUMS), wp.float64, device)
    matches = _empty(cloud.count, int, device)
    distances2 = _empty(cloud.count, float, device)
    iterations, converged = 0, False
    for stage in stages:
        part = cloud.thinned(stage.thinning)
        for _ in range(stage.iterations):
            gicp.match_points(
                part.points,
                target.grid,
                pose,
                radius=stage.radius,
                matches=matches,
                distances2=distances2,
                device=device,
            )
            gicp.linearise(
                part.points,
                part.covariances,
                target.grid,
                target.covariances,
                pose,
                matches,
                robust_scale=stage.robust_scale,
                sums=sums,
                system=system,
                device=device,
            )
            gicp.update_pose(system, damping=0.0, pose=pose, step=step, device=device)
            iterations += 1
            converged = bool(to_host(step).max() < stage.tolerance)
            if converged:
                break
    numbers: Float64 = np.asarray(to_host(system), np.float64)
    return Registration(
        T_wc=to_host(pose)[0].copy(),
        information=unpack_information(numbers),
        cost=float(numbers[27]),
        matched=int(numbers[28]),
        converged=converged,
        iterations=iterations,
    )


def unpack_information(system: Float64) -> Float64:
    """Return H [6, 6] of a system as :func:`ggwarp.kernels.gicp.linearise` packs it."""
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = system[:21]
    return H + np.triu(H, 1).T


def match_distances2(cloud: Cloud, target: Target, T_wc: Float64, *, radius: float, device: Any) -> Any:
    """Return [n] float32 squared distances to the nearest map point at ``T_wc``; inf beyond ``radius``."""
    pose = wp.array(np.asarray(T_wc, np.float64)[None], dtype=wp.mat44d, device=device)
    matches = _empty(cloud.count, int, device)
    distances2 = _empty(cloud.count, float, device)
    gicp.match_points(
        cloud.points, target.grid, pose, radius=radius, matches=matches, distances2=distances2, device=device
    )
    return to_host(distances2)


def _empty(shape: Any, dtype: Any, device: Any) -> Any:
    return wp.empty(shape, dtype=dtype, device=device)
