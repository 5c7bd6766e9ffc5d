# SPDX-License-Identifier: Apache-2.0
"""The arrays of a registration, and the two copies between host and device that one takes."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels.registration import gicp, gicp_loop
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64

_POSE = 16
"""Numbers of a pose."""

_ALIGNMENT = 16
"""Bytes."""

_STAGE: Any = gicp.StageSettings
_STAGE_ROW: Any = np.dtype(_STAGE.numpy_dtype())


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


class RegistrationArrays:
    """What registrations of up to so many points, in up to so many stages, work on.

    All that the host says of one lies together, and what it reads in the end lies in that: a copy each way.

    Attributes:
        loop: for :mod:`ggwarp.kernels.registration.gicp_loop`.
        across: [SUMS] float64, for :func:`ggwarp.kernels.registration.gicp_pairs.fix_across`.
        matches: [points] int, and per_point: [points] float, for what is said of each point.
    """

    def __init__(self, points: int, stages: int, device: Any) -> None:
        """Allocate."""
        points, stages = max(1, points), max(1, stages)
        problem_type: Any = gicp.Problem
        self._problem = problem_type()
        self._cloud: Cloud | None = None
        self._target: RegistrationTarget | None = None
        stages_at = _aligned(ctypes.sizeof(self._problem.__ctype__()))
        numbers_at = stages_at + _aligned(stages * _STAGE_ROW.itemsize)
        count = _POSE + gicp.SUMS + gicp_loop.PROGRESS + gicp.SUMS
        # The host's image of the device's bytes, and parts of both.
        self._host = np.zeros(numbers_at + 8 * count, np.uint8)
        byte: Any = wp.uint8
        self._image: Any = wp.array(self._host, dtype=byte, device="cpu", copy=False)
        self._bytes: Any = wp.zeros(len(self._host), dtype=byte, device=device)
        self._stages = np.ndarray(stages, _STAGE_ROW, self._host, stages_at)
        self._start = np.ndarray((4, 4), np.float64, self._host, numbers_at)

        def part(at: int, shape: Any, dtype: Any) -> Any:
            array = wp.array(ptr=self._bytes.ptr + at, dtype=dtype, shape=shape, device=device)
            array._ref = self._bytes
            return array

        def empty(shape: Any, dtype: Any) -> Any:
            return wp.empty(shape, dtype=dtype, device=device)

        number: Any = wp.float64
        self._numbers = part(numbers_at, count, number)
        self.across = self._numbers[-gicp.SUMS :]
        self.matches, self.per_point = (empty(points, dtype) for dtype in (int, float))
        rows = gicp.block_count(points, device)
        self.loop = gicp_loop.LoopArrays(
            problem=part(0, 1, gicp.Problem),
            stages=part(stages_at, stages, _STAGE),
            pose=part(numbers_at, 1, wp.mat44d),
            system=self._numbers[_POSE : _POSE + gicp.SUMS],
            progress=self._numbers[_POSE + gicp.SUMS : -gicp.SUMS],
            state=empty(gicp_loop.STATES, wp.int32),
            sums=empty((rows, gicp.SUMS), number),
            folded=empty((gicp.FOLDED, gicp.SUMS), number),
        )

    def load(
        self, cloud: Cloud, target: RegistrationTarget, T_wc: Float64, stages: Sequence[RegistrationStage]
    ) -> None:
        """Say what is registered, from ``T_wc`` [4, 4] on; all sums are 0 then."""
        if cloud is not self._cloud or target is not self._target:
            self._cloud, self._target = cloud, target
            problem = self._problem
            problem.points, problem.covariances = cloud.points, cloud.covariances
            problem.grid, problem.grid_covariances = target.grid, target.covariances
            packed = problem.__ctype__()
            self._host[: ctypes.sizeof(packed)] = np.frombuffer(packed, np.uint8)
        for row, stage in enumerate(stages):
            self._stages[row] = tuple(getattr(stage, name) for name in _STAGE_ROW.names)
        self._start[:] = T_wc
        wp.copy(self._bytes, self._image)

    def read(self) -> tuple[Float64, Float64, Float64, Float64]:
        """Return the pose [4, 4], the last system [SUMS], the progress [PROGRESS] and ``across`` [SUMS]."""
        numbers: Float64 = np.array(to_host(self._numbers), np.float64)
        system, across = numbers[_POSE : _POSE + gicp.SUMS], numbers[-gicp.SUMS :]
        return numbers[:_POSE].reshape(4, 4), system, numbers[_POSE + gicp.SUMS : -gicp.SUMS], across


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
