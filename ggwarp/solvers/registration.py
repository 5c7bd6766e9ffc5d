# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of a frame's points to a map: the kernels of one registration, in their order.

Works on Warp arrays; :func:`ggwarp.ops.gicp` is the same for torch tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels.registration import covariance, gicp, gicp_loop, gicp_pairs, hash_grid
from ggwarp.runtime.graphs import GraphCache
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.registration_arrays import (
    Cloud,
    RegistrationArrays,
    RegistrationStage,
    RegistrationTarget,
)
from ggwarp.types import Float32, Float64

_GROWTH = 1.5

_PLACES = np.zeros((6, 6), np.intp)
"""Where a system has each number of H."""
_PLACES[np.triu_indices(6)] = np.arange(21)
_PLACES = np.maximum(_PLACES, _PLACES.T)

_MEDIAN_CHI2 = 0.455
"""Median of the chi-squared distribution of one degree of freedom."""


@dataclass(frozen=True)
class Registration:
    """Where a registration ended.

    Attributes:
        T_wc: [4, 4] float64.
        information: [6, 6] float64, H at the last linearisation: the inverse covariance of the pose in
            the camera, (translation, rotation), if the points' covariances are those of their noise.
        across: [6, 6] float64, the part of it that surfaces say where they face, at the pose found: without
            what lies along them; see :func:`ggwarp.kernels.registration.gicp_pairs.fix_across`.
        cost: robust cost there.
        matched: matched pairs there.
        converged: whether the last stage's last step was below its tolerance.
        iterations: linearisations in all.
        residual_scale: see :meth:`Registrar.residual_scale`, where it was measured.
    """

    T_wc: Float64
    information: Float64
    across: Float64
    cost: float
    matched: int
    converged: bool
    iterations: int
    residual_scale: float = 1.0


def build_target(means: Any, quats: Any, scales: Any, *, cell_size: float, device: Any) -> RegistrationTarget:
    """Sort a map's ellipses into a grid.

    Args:
        means, quats, scales: [n] wp.vec3, wp.vec4 (w first), wp.vec3, world frame, metres.
        cell_size: metres.
    """
    n = means.shape[0]
    grid = hash_grid.allocate_hash_grid(n, device=device)
    hash_grid.build_hash_grid(grid, means, cell_size=cell_size, device=device)
    matrix: Any = wp.mat33
    covariances = wp.empty(n, dtype=matrix, device=device)
    covariance.build_covariances(quats, scales, order=grid.indices, covariances=covariances, device=device)
    return RegistrationTarget(grid, covariances)


def register(
    cloud: Cloud,
    target: RegistrationTarget,
    T_start: Float64,
    stages: list[RegistrationStage],
    *,
    device: Any,
) -> Registration:
    """Find the pose that lays ``cloud`` on ``target``; see :class:`Registrar`."""
    return Registrar(device=device, recorded=False).register(cloud, target, T_start, stages)


class Registrar(Stateful):
    """Registers one cloud after another in arrays that it keeps.

    Recorded, the whole registration is one graph, whatever the cloud and the target: it is recorded anew only
    where a cloud outgrows the arrays. The result is read once.
    """

    def __init__(self, *, device: Any, recorded: bool | None = None) -> None:
        """Allocate nothing yet.

        Args:
            recorded: record and replay; the default does on CUDA where the driver has loops in graphs. On the
                CPU a recording runs on one thread.
        """
        self._device = wp.get_device(device)
        if recorded is None:
            recorded = self._device.is_cuda and wp.is_conditional_graph_supported()
        self._recorded = recorded
        self._graphs = GraphCache(self._device)
        self._room = (0, 0)

    def state(self) -> State:
        """Return how much room there is: on CUDA sums are taken over all of it."""
        return {"room": list(self._room)}

    def restore(self, state: State, frames: FrameSource) -> None:
        """Make the same room."""
        points, stages = state["room"]
        if points:
            self._allocate(points, stages)

    def register(
        self,
        cloud: Cloud,
        target: RegistrationTarget,
        T_start: Float64,
        stages: list[RegistrationStage],
        *,
        across: bool = True,
        residual_radius: float | None = None,
    ) -> Registration:
        """Find the pose that lays ``cloud`` on ``target``.

        Args:
            cloud: points and covariances, camera frame.
            T_start: [4, 4] camera-to-world, where to start.
            stages: coarse to fine.
            across: say what surfaces fix across themselves; else that is 0.
            residual_radius: measure :meth:`residual_scale` at the pose found, too, with this radius.
        """
        self._reserve(cloud.count, len(stages))
        self._arrays.load(cloud, target, T_start, stages)
        thinnings = tuple(stage.thinning for stage in stages)
        if self._recorded and stages:
            room, variant = self._room[0], (thinnings, across)
            self._graphs.run(variant, lambda: self._run(thinnings, room, across), arrays=self._room)
        elif stages:
            self._run(thinnings, cloud.count, across)
        if residual_radius is not None:
            self._pair_residuals(cloud.count, residual_radius)
        found = self._result()
        return found if residual_radius is None else replace(found, residual_scale=self._scale(cloud.count))

    def residual_scale(
        self, cloud: Cloud, target: RegistrationTarget, T_wc: Float64, *, radius: float
    ) -> float:
        """Return how large the points' residuals are, as a share of what their covariances let expect.

        From the median, which the farther half of them does not reach: 1 where noise is what it is taken for;
        the residual of two surfaces has one degree of freedom. inf where half the points have no match.

        Args:
            T_wc: [4, 4] camera-to-world.
            radius: farthest match, metres.
        """
        self._reserve(cloud.count, 0)
        self._arrays.load(cloud, target, T_wc, [])
        self._pair_residuals(cloud.count, radius)
        return self._scale(cloud.count)

    def _pair_residuals(self, count: int, radius: float) -> None:
        gicp_pairs.pair_residuals(
            self._arrays.loop.problem,
            self._arrays.loop.pose,
            count=count,
            radius=radius,
            residuals2=self._arrays.per_point,
            device=self._device,
        )

    def _scale(self, count: int) -> float:
        if not count:
            return float("inf")
        # Of an even number the higher one: the mean with an inf would be one.
        found = np.partition(to_host(self._arrays.per_point[:count]), count // 2)
        return float(np.sqrt(found[count // 2] / _MEDIAN_CHI2))

    def match_distances2(
        self, cloud: Cloud, target: RegistrationTarget, T_wc: Float64, *, radius: float
    ) -> Float32:
        """Return [n] the points' squared distances, m^2, to the nearest of the map; inf beyond ``radius``.

        They hold until the next call of any method.

        Args:
            T_wc: [4, 4] camera-to-world.
            radius: metres.
        """
        self._reserve(cloud.count, 0)
        self._arrays.load(cloud, target, T_wc, [])
        distances2 = self._arrays.per_point[: cloud.count]
        gicp.match_points(
            self._arrays.loop.problem,
            self._arrays.loop.pose,
            count=cloud.count,
            radius=radius,
            distances2=distances2,
            device=self._device,
        )
        return to_host(distances2)

    def _run(self, thinnings: Sequence[int], count: int, across: bool) -> None:
        loop = self._arrays.loop
        for stage, thinning in enumerate(thinnings):
            gicp_loop.run_stage(loop, stage=stage, count=-(-count // thinning), device=self._device)
        if not across:
            return
        gicp_pairs.fix_across(
            loop.problem,
            loop.stages,
            stage=len(thinnings) - 1,
            count=count,
            pose=loop.pose,
            sums=loop.sums,
            folded=loop.folded,
            system=self._arrays.across,
            device=self._device,
        )

    def _reserve(self, points: int, stages: int) -> None:
        if points <= self._room[0] and stages <= self._room[1]:
            return
        self._allocate(max(int(_GROWTH * points), self._room[0]), max(stages, self._room[1]))

    def _allocate(self, points: int, stages: int) -> None:
        self._room = (points, stages)
        self._arrays = RegistrationArrays(points, stages, self._device)

    def _result(self) -> Registration:
        T_wc, system, progress, across = self._arrays.read()
        return Registration(
            T_wc=T_wc,
            information=unpack_information(system),
            across=unpack_information(across),
            cost=float(system[27]),
            matched=int(system[28]),
            converged=bool(progress[gicp_loop.CONVERGED]),
            iterations=int(progress[gicp_loop.ITERATIONS]),
        )


def unpack_information(system: Float64) -> Float64:
    """Return H [6, 6] of a system as :func:`ggwarp.kernels.registration.gicp.linearisation` packs it."""
    return system[_PLACES]
