# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP: correspondences and the 6x6 system.

For matched a_i (frame, camera coordinates) and b_i (map, world coordinates) with covariances A_i, B_i:

    e_i = R^T (b_i - t) - a_i,    M_i = (R^T B_i R + A_i)^-1,    cost = sum rho(e_i^T M_i e_i)

and T_wc <- T_wc Exp(xi), xi = (v, w): de = -(v + w x a). Everything is expressed in the camera, whose points
lie around the origin, and summed in double precision, so that float32 points are enough for 0.01 mm.

The sums go points -> block -> system, each in a fixed order: the bits do not depend on threads or device
scheduling. What changes from frame to frame lies in arrays, so that one recording of the loop
(:mod:`ggwarp.kernels.registration.gicp_loop`) serves them all.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.registration.hash_grid import HashGrid, nearest_in_grid
from ggwarp.kernels.rigid import matrix_to_double, rotation_d, to_double, translation_d
from ggwarp.runtime.launch import block_size, launch_split

# A frame has some ten thousand points, a thread each with two hundred registers: small blocks reach all
# multiprocessors.
wp.set_module_options({"enable_backward": False, "block_dim": 64})

SUMS = 29
"""Numbers of a system: 21 of the upper triangle of H by rows, 6 of g, the robust cost, the matched pairs."""

FOLDED = 64
"""Rows that many rows of sums are folded to first."""

vec29d = wp.types.vector(SUMS, wp.float64)


@wp.kernel
def _match(
    offset: int,
    points: wp.array[wp.vec3],
    grid: HashGrid,
    pose: wp.array[wp.mat44d],
    radius: float,
    matches: wp.array[int],
    distances2: wp.array[float],
):
    i = offset + wp.tid()
    q = rotation_d(pose[0]) * to_double(points[i]) + translation_d(pose[0])
    j, d2 = nearest_in_grid(grid, wp.vec3(float(q[0]), float(q[1]), float(q[2])), radius)
    matches[i] = j
    distances2[i] = wp.where(j >= 0, d2, wp.inf)


def match_points(
    points: Any, grid: Any, pose: Any, *, radius: float, matches: Any, distances2: Any, device: Any
) -> None:
    """Find each frame point's nearest map point.

    Args:
        points: [n] wp.vec3, camera frame, metres.
        grid: built :class:`HashGrid` of the map's points, world frame.
        pose: [1] wp.mat44d, T_wc.
        radius: metres.
        matches: [n] int, written: place in the *grid's* order, -1 for none.
        distances2: [n] float, written: squared distance, m^2; inf for none.
    """
    launch_split(
        _match,
        points.shape[0],
        inputs=[points, grid, pose, radius],
        outputs=[matches, distances2],
        device=device,
    )


@wp.func
def robust_weight(e2: wp.float64, scale2: wp.float64) -> wp.float64:
    """Geman-McClure: derivative of rho(x) = x / (1 + x / scale2)."""
    w = scale2 / (scale2 + e2)
    return w * w


@wp.struct
class Problem:
    """A frame's points in camera coordinates, and the map in world coordinates that they are laid on."""

    points: wp.array[wp.vec3]
    covariances: wp.array[wp.mat33]
    grid: HashGrid
    grid_covariances: wp.array[wp.mat33]


@wp.struct
class StageSettings:
    """See :class:`ggwarp.solvers.registration.RegistrationStage`."""

    radius: float
    iterations: int
    tolerance: wp.float64
    robust_scale: wp.float64
    thinning: int


@wp.func
def matched_pair(problem: Problem, i: int, pose: wp.mat44d, radius: float):
    """Return where point i's match is in the grid's order, -1 for none; e_i and M_i."""
    R = rotation_d(pose)
    Rt = wp.transpose(R)
    t = translation_d(pose)
    a = to_double(problem.points[i])
    q = R * a + t
    j, _d2 = nearest_in_grid(problem.grid, wp.vec3(float(q[0]), float(q[1]), float(q[2])), radius)
    e = wp.vec3d()
    M = wp.mat33d()
    if j >= 0:
        e = Rt * (to_double(problem.grid.points[j]) - t) - a
        B = matrix_to_double(problem.grid_covariances[j])
        M = wp.inverse(Rt * B * R + matrix_to_double(problem.covariances[i]))
    return j, e, M


@wp.kernel
def _linearise(
    offset: int,
    problems: wp.array[Problem],
    stages: wp.array[StageSettings],
    stage: int,
    per_block: int,
    pose: wp.array[wp.mat44d],
    sums: wp.array2d[wp.float64],
):
    block = offset + wp.tid()
    problem = problems[0]
    settings = stages[stage]
    scale2 = settings.robust_scale * settings.robust_scale
    used = (problem.points.shape[0] + settings.thinning - 1) / settings.thinning
    total = vec29d()
    for place in range(block * per_block, wp.min((block + 1) * per_block, used)):
        i = place * settings.thinning
        j, e, M = matched_pair(problem, i, pose[0], settings.radius)
        if j >= 0:
            a = to_double(problem.points[i])
            Me = M * e
            e2 = wp.dot(e, Me)
            w = robust_weight(e2, scale2)
            # Rows of J^T = (I, [a]x): -de/dxi transposed.
            A = wp.skew(a)
            MA = M * A
            AMA = A * MA
            k = int(0)
            for r in range(3):
                for c in range(r, 3):
                    total[k] += w * M[r, c]
                    k += 1
                for c in range(3):
                    total[k] -= w * MA[r, c]
                    k += 1
            for r in range(3):
                for c in range(r, 3):
                    total[k] -= w * AMA[r, c]
                    k += 1
            torque = wp.cross(a, Me)
            for r in range(3):
                total[21 + r] += w * Me[r]
                total[24 + r] += w * torque[r]
            total[27] += e2 * wp.sqrt(w)
            total[28] += wp.float64(1.0)
    for k in range(wp.static(SUMS)):
        sums[block, k] = total[k]


@wp.kernel
def _fold(sums: wp.array2d[wp.float64], rows: int, folded: wp.array2d[wp.float64]):
    """Row f of ``folded``: the sum of rows f, f + F, ... of ``sums``, F being the rows of ``folded``."""
    f, k = wp.tid()
    total = wp.float64(0.0)
    for row in range(f, rows, folded.shape[0]):
        total += sums[row, k]
    folded[f, k] = total


@wp.kernel
def _reduce(sums: wp.array2d[wp.float64], rows: int, system: wp.array[wp.float64]):
    k = wp.tid()
    total = wp.float64(0.0)
    for row in range(rows):
        total += sums[row, k]
    system[k] = total


def points_per_block(device: Any) -> int:
    """Return how many points one thread sums: many on a CPU; one on CUDA, which still leaves cores idle."""
    return 32 if wp.get_device(device).is_cpu else 1


def block_count(n: int, device: Any) -> int:
    """Return the rows of ``sums`` that ``n`` points need."""
    return -(-n // points_per_block(device))


def linearise(
    problem: Any,
    stages: Any,
    *,
    stage: int,
    count: int,
    pose: Any,
    sums: Any,
    folded: Any,
    system: Any,
    device: Any,
) -> None:
    """Match the points to the map and sum the normal equations H xi = g of the pairs.

    Args:
        problem: [1] :class:`Problem`, the grid built, its covariances in the grid's order.
        stages: [stages] :class:`StageSettings`.
        stage: which of them.
        count: at least the points that this stage uses of the problem's.
        pose: [1] wp.mat44d, T_wc.
        sums: [>= block_count(count), SUMS] float64, scratch.
        folded: [F, SUMS] float64, scratch.
        system: [SUMS] float64, written; see :data:`SUMS`.
    """
    sum_blocks(
        _linearise,
        block_count(count, device),
        inputs=[problem, stages, stage, points_per_block(device), pose],
        sums=sums,
        folded=folded,
        system=system,
        device=device,
    )


def sum_blocks(
    kernel: Any, rows: int, *, inputs: list[Any], sums: Any, folded: Any, system: Any, device: Any
) -> None:
    launch_split(kernel, rows, inputs=inputs, outputs=[sums], device=device, min_piece=4)
    if rows > FOLDED * 8:
        wp.launch(
            _fold,
            dim=folded.shape,
            inputs=[sums, rows],
            outputs=[folded],
            device=device,
            block_dim=block_size(_fold),
        )
        sums, rows = folded, folded.shape[0]
    wp.launch(
        _reduce,
        dim=SUMS,
        inputs=[sums, rows],
        outputs=[system],
        device=device,
        block_dim=block_size(_reduce),
    )
