# SPDX-License-Identifier: Apache-2.0
"""The loop of generalised ICP on the device: linearise, solve, move the pose, until the step is small.

The host reads nothing on the way, so that the whole loop can be one recorded graph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.math import mat66d, solve_positive, vec6d
from ggwarp.kernels.registration.gicp import StageSettings, linearisation
from ggwarp.kernels.rigid import orthonormalised, se3_exp
from ggwarp.runtime.launch import Work, in_turn, prepared

wp.set_module_options({"enable_backward": False})

ACTIVE, LEFT, STATES = 0, 1, 2
"""Places in the state: whether the stage goes on, and for how many linearisations at most."""

TRANSLATION, ROTATION, ITERATIONS, CONVERGED, PROGRESS = range(5)
"""Places in the progress: the last step, metres and radians; linearisations in all; whether it was small."""


@wp.kernel
def _begin_kernel(stages: wp.array[StageSettings], stage: int, state: wp.array[int]):
    state[ACTIVE] = wp.min(stages[stage].iterations, 1)
    state[LEFT] = stages[stage].iterations


@wp.kernel
def _update_kernel(
    stages: wp.array[StageSettings],
    stage: int,
    damping: wp.float64,
    system: wp.array[wp.float64],
    pose: wp.array[wp.mat44d],
    progress: wp.array[wp.float64],
    state: wp.array[int],
):
    H = mat66d()
    g = vec6d()
    k = int(0)
    for r in range(6):
        g[r] = system[21 + r]
        for c in range(r, 6):
            H[r, c] = system[k]
            H[c, r] = system[k]
            k += 1
    for r in range(6):
        H[r, r] += damping * H[r, r]
    xi = solve_positive(H, g)
    pose[0] = orthonormalised(pose[0] * se3_exp(xi))
    v = wp.sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    w = wp.sqrt(xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5])
    left = state[LEFT] - 1
    small = wp.where(v < stages[stage].tolerance and w < stages[stage].tolerance, 1, 0)
    progress[TRANSLATION] = v
    progress[ROTATION] = w
    progress[ITERATIONS] += wp.float64(1.0)
    progress[CONVERGED] = wp.float64(small)
    state[LEFT] = left
    state[ACTIVE] = wp.where(left > 0 and small == 0, 1, 0)


@dataclass(frozen=True)
class LoopArrays:
    """What a registration works on, for S stages.

    Attributes:
        problem: [1] :class:`ggwarp.kernels.registration.gicp.Problem`.
        stages: [S] :class:`ggwarp.kernels.registration.gicp.StageSettings`.
        pose: [1] wp.mat44d, T_wc, improved.
        system: [SUMS] float64, the last linearisation.
        progress: [PROGRESS] float64, zeros at first.
        state: [STATES] int, sums: [rows, SUMS] and folded: [FOLDED, SUMS] float64: scratch.
    """

    problem: Any
    stages: Any
    pose: Any
    system: Any
    progress: Any
    state: Any
    sums: Any
    folded: Any


def pose_update(arrays: LoopArrays, *, stage: int, damping: float = 0.0, device: Any) -> Work:
    """Return what solves (H + damping diag H) xi = g and sets T_wc <- T_wc Exp(xi); singular, it stays.

    Args:
        damping: Levenberg-Marquardt's relative damping.
    """
    inputs = [arrays.stages, stage, damping, arrays.system]
    outputs = [arrays.pose, arrays.progress, arrays.state]
    return prepared(_update_kernel, 1, inputs=inputs, outputs=outputs, device=device)


def run_stage(arrays: LoopArrays, *, stage: int, count: int, device: Any) -> None:
    """Linearise and update until the step is below the stage's tolerance, or as often as it allows.

    In a recording this is a loop of the graph's, else one of the host's, which reads the state.

    Args:
        count: at least the points that the stage uses.
    """
    step = in_turn(
        linearisation(
            arrays.problem,
            arrays.stages,
            stage=stage,
            count=count,
            pose=arrays.pose,
            sums=arrays.sums,
            folded=arrays.folded,
            system=arrays.system,
            device=device,
        ),
        pose_update(arrays, stage=stage, device=device),
    )
    wp.launch(_begin_kernel, dim=1, inputs=[arrays.stages, stage], outputs=[arrays.state], device=device)
    wp.capture_while(arrays.state[ACTIVE : ACTIVE + 1], step)
