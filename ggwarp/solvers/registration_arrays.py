# SPDX-License-Identifier: Apache-2.0
"""The arrays of a registration, and the two copies between host and device that one takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.registration import gicp, gicp_loop
from ggwarp.runtime.packed_arrays import PackedArrays, as_rows, numpy_type
from ggwarp.types import Float64

_STAGE: Any = gicp.StageSettings
_STAGE_FIELDS = numpy_type(_STAGE).names or ()


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
        per_point: [points] float, for what is said of each point.
    """

    def __init__(self, points: int, stages: int, device: Any) -> None:
        """Allocate."""
        points, stages = max(1, points), max(1, stages)
        problem_type: Any = gicp.Problem
        self._problem = problem_type()
        self._cloud: Cloud | None = None
        self._target: RegistrationTarget | None = None
        number: Any = wp.float64
        self._packed = PackedArrays(
            {
                "problem": (gicp.Problem, 1),
                "stages": (_STAGE, stages),
                "pose": (wp.mat44d, 1),
                "system": (number, gicp.SUMS),
                "progress": (number, gicp_loop.PROGRESS),
                "across": (number, gicp.SUMS),
            },
            device,
        )

        def empty(shape: Any, dtype: Any) -> Any:
            return wp.empty(shape, dtype=dtype, device=device)

        packed = self._packed.device
        self.across = packed["across"]
        self.per_point = empty(points, float)
        self._matches, self._searched = empty(points, int), empty(points, wp.vec4)
        rows = gicp.block_count(points, device)
        self.loop = gicp_loop.LoopArrays(
            problem=packed["problem"],
            stages=packed["stages"],
            pose=packed["pose"],
            system=packed["system"],
            progress=packed["progress"],
            state=empty(gicp_loop.STATES, wp.int32),
            sums=empty((rows, gicp.SUMS), number),
            folded=empty((gicp.FOLDED, gicp.SUMS), number),
        )

    def load(
        self, cloud: Cloud, target: RegistrationTarget, T_wc: Float64, stages: Sequence[RegistrationStage]
    ) -> None:
        """Say what is registered, from ``T_wc`` [4, 4] on; all sums are 0 then.

        The arrays of a cloud and a target stay as they are while they are registered again and again.
        """
        host = self._packed.host
        if cloud is not self._cloud or target is not self._target:
            self._cloud, self._target = cloud, target
            problem = self._problem
            problem.points, problem.covariances = cloud.points, cloud.covariances
            problem.grid, problem.grid_covariances = target.grid, target.covariances
            problem.matches, problem.searched = self._matches, self._searched
            self._searched.zero_()
            host["problem"][:] = as_rows(gicp.Problem, [problem])
        for row, stage in enumerate(stages):
            host["stages"][row] = tuple(getattr(stage, name) for name in _STAGE_FIELDS)
        host["pose"][0] = T_wc
        self._packed.upload()

    def read(self) -> tuple[Float64, Float64, Float64, Float64]:
        """Return the pose [4, 4], the last system [SUMS], the progress [PROGRESS] and ``across`` [SUMS]."""
        found = self._packed.read()
        return found["pose"][0], found["system"], found["progress"], found["across"]
