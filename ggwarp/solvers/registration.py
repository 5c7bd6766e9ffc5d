# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of a frame's points to a map: the kernels of one registration, in their order.

Works on Warp arrays; :func:`ggwarp.ops.gicp` is the same for torch tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels.registration import covariance, gicp, gicp_loop, gicp_pairs, hash_grid
from ggwarp.runtime.graphs import GraphCache
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64

_POSE = 16
"""Numbers of a pose."""

_GROWTH = 1.5

_MEDIAN_CHI2 = 0.455
"""Median of the chi-squared distribution of one degree of freedom."""


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


@dataclass(frozen=True)
class RegistrationTarget:
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
class RegistrationStage:
    """Linearisations that share a correspondence radius.

    Attributes:
        radius: farthest match, metres.
        iterations: linearisations at most.
        tolerance: converged when a step is smaller, metres and radians.
        robust_scale: Geman-McClure's, standard deviations; the default is plain least squares.
        thinning: use every thinning-th point.
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
    covariances = _empty(n, wp.mat33, device)
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
        self, cloud: Cloud, target: RegistrationTarget, T_start: Float64, stages: list[RegistrationStage]
    ) -> Registration:
        """Find the pose that lays ``cloud`` on ``target``.

        Args:
            cloud: points and covariances, camera frame.
            T_start: [4, 4] camera-to-world, where to start.
            stages: coarse to fine.
        """
        self._reserve(cloud.count, len(stages))
        self._load(cloud, target, T_start, stages)
        if self._recorded and stages:
            thinnings = tuple(stage.thinning for stage in stages)
            room = self._room[0]
            self._graphs.run(thinnings, lambda: self._run(thinnings, room), arrays=self._room)
        else:
            self._run([stage.thinning for stage in stages], cloud.count)
        if stages:
            gicp_pairs.fix_across(
                self._arrays.problem,
                self._arrays.stages,
                stage=len(stages) - 1,
                count=cloud.count,
                pose=self._arrays.pose,
                sums=self._arrays.sums,
                folded=self._arrays.folded,
                system=self._across,
                device=self._device,
            )
        return self._result()

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
        self._load(cloud, target, T_wc, [])
        gicp_pairs.pair_residuals(
            self._arrays.problem,
            self._arrays.pose,
            count=cloud.count,
            radius=radius,
            residuals2=self._residuals2,
            device=self._device,
        )
        if not cloud.count:
            return float("inf")
        # Of an even number the higher one: the mean with an inf would be one.
        found = np.partition(to_host(self._residuals2[: cloud.count]), cloud.count // 2)
        return float(np.sqrt(found[cloud.count // 2] / _MEDIAN_CHI2))

    def _run(self, thinnings: Sequence[int], count: int) -> None:
        for stage, thinning in enumerate(thinnings):
            gicp_loop.run_stage(self._arrays, stage=stage, count=-(-count // thinning), device=self._device)

    def _reserve(self, points: int, stages: int) -> None:
        if points <= self._room[0] and stages <= self._room[1]:
            return
        self._allocate(max(int(_GROWTH * points), self._room[0]), max(stages, self._room[1]))

    def _allocate(self, points: int, stages: int) -> None:
        self._room = (points, stages)

        def zeros(shape: Any, dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, device=self._device)

        # What is read in the end lies together.
        self._numbers = zeros(_POSE + gicp.SUMS + gicp_loop.PROGRESS + gicp.SUMS, wp.float64)
        matrix: Any = wp.mat44d
        pose = wp.array(ptr=self._numbers.ptr, dtype=matrix, shape=1, device=self._device)
        pose._ref = self._numbers
        self._across = self._numbers[-gicp.SUMS :]
        self._residuals2 = zeros(max(1, points), wp.float32)
        rows = max(1, gicp.block_count(self._room[0], self._device))
        self._arrays = gicp_loop.LoopArrays(
            problem=zeros(1, gicp.Problem),
            stages=zeros(max(1, self._room[1]), gicp.StageSettings),
            pose=pose,
            system=self._numbers[_POSE : _POSE + gicp.SUMS],
            progress=self._numbers[_POSE + gicp.SUMS : -gicp.SUMS],
            state=zeros(gicp_loop.STATES, wp.int32),
            sums=zeros((rows, gicp.SUMS), wp.float64),
            folded=zeros((gicp.FOLDED, gicp.SUMS), wp.float64),
        )

    def _load(
        self, cloud: Cloud, target: RegistrationTarget, T_start: Float64, stages: list[RegistrationStage]
    ) -> None:
        problem: Any = gicp.Problem()
        problem.points, problem.covariances = cloud.points, cloud.covariances
        problem.grid, problem.grid_covariances = target.grid, target.covariances
        self._arrays.problem.assign([problem])
        rows = []
        for stage in stages:
            row: Any = gicp.StageSettings()
            for name in ("radius", "iterations", "tolerance", "robust_scale", "thinning"):
                setattr(row, name, getattr(stage, name))
            rows.append(row)
        if rows:
            self._arrays.stages[: len(rows)].assign(rows)
        numbers = np.zeros(self._numbers.shape[0])
        numbers[:_POSE] = np.asarray(T_start, np.float64).ravel()
        self._numbers.assign(numbers)

    def _result(self) -> Registration:
        numbers: Float64 = np.array(to_host(self._numbers), np.float64)
        system, progress = numbers[_POSE : _POSE + gicp.SUMS], numbers[_POSE + gicp.SUMS : -gicp.SUMS]
        return Registration(
            T_wc=numbers[:_POSE].reshape(4, 4),
            information=unpack_information(system),
            across=unpack_information(numbers[-gicp.SUMS :]),
            cost=float(system[27]),
            matched=int(system[28]),
            converged=bool(progress[gicp_loop.CONVERGED]),
            iterations=int(progress[gicp_loop.ITERATIONS]),
        )


def unpack_information(system: Float64) -> Float64:
    """Return H [6, 6] of a system as :func:`ggwarp.kernels.registration.gicp.linearise` packs it."""
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = system[:21]
    return H + np.triu(H, 1).T


def match_distances2(
    cloud: Cloud, target: RegistrationTarget, T_wc: Float64, *, radius: float, device: Any
) -> Any:
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
