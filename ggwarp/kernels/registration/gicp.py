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

from ggwarp.kernels.registration.hash_grid import HashGrid, nearest_and_others
from ggwarp.kernels.rigid import matrix_to_double, rotation_d, to_double, translation_d
from ggwarp.runtime.launch import Work, in_turn, launch_split, prepared, prepared_split

# A frame has some ten thousand points, a thread each with two hundred registers: small blocks reach all
# multiprocessors.
wp.set_module_options({"enable_backward": False, "block_dim": 64})

SUMS = 29
"""Numbers of a system: 21 of the upper triangle of H by rows, 6 of g, the robust cost, the matched pairs."""

FOLDED = 64
"""Rows that many rows of sums are folded to first."""

_SLACK = wp.constant(0.1)
"""Others are looked for up to so many cells farther than the nearest: a match holds longer then."""

_ROUNDING = wp.constant(1.0e-6)

vec29d = wp.types.vector(SUMS, wp.float64)


@wp.func
def robust_weight(e2: wp.float64, scale2: wp.float64) -> wp.float64:
    """Geman-McClure: derivative of rho(x) = x / (1 + x / scale2)."""
    w = scale2 / (scale2 + e2)
    return w * w


@wp.struct
class Problem:
    """A frame's points in camera coordinates, and the map in world coordinates that they are laid on.

    A point's last search is kept: its match stays while it moves by less than others are farther away, as
    most do from one linearisation to the next. What is found is the same to the bit.

    Attributes:
        matches: [n] the last matches' places in the grid's order, -1 for none.
        searched: [n] where the point was then, world frame, and how far away all others were at least; zeros
            where there was no search. Without it every match is looked for.
    """

    points: wp.array[wp.vec3]
    covariances: wp.array[wp.mat33]
    grid: HashGrid
    grid_covariances: wp.array[wp.mat33]
    matches: wp.array[int]
    searched: wp.array[wp.vec4]


@wp.struct
class StageSettings:
    """See :class:`ggwarp.solvers.registration.RegistrationStage`."""

    radius: float
    iterations: int
    tolerance: wp.float64
    robust_scale: wp.float64
    thinning: int


@wp.func
def match_of(problem: Problem, i: int, q: wp.vec3, radius: float):
    """Return where point i's match is in the grid's order, -1 for none, and its squared distance.

    Args:
        q: the point in the world.
    """
    grid = problem.grid
    kept = problem.searched.shape[0] > 0
    if kept:
        last = problem.searched[i]
        before = wp.vec3(last[0], last[1], last[2])
        # With more than what floats round off.
        moved = wp.length(q - before) + _ROUNDING * (wp.abs(q[0]) + wp.abs(q[1]) + wp.abs(q[2]))
        others = last[3] - moved
        j = problem.matches[i]
        if j < 0 and others > radius:
            return j, radius * radius
        if j >= 0 and others > 0.0:
            d2 = wp.length_sq(grid.points[j] - q)
            if d2 < others * others:
                return wp.where(d2 <= radius * radius, j, -1), d2
    slack = wp.where(kept, _SLACK * grid.cell_size, 0.0)
    j, d2, others2 = nearest_and_others(grid, q, radius + slack, slack)
    if kept:
        problem.matches[i] = j
        problem.searched[i] = wp.vec4(q[0], q[1], q[2], wp.sqrt(others2))
    return wp.where(d2 <= radius * radius, j, -1), d2


@wp.func
def in_world(problem: Problem, i: int, pose: wp.mat44d) -> wp.vec3:
    """Return point i where ``pose`` puts it."""
    q = rotation_d(pose) * to_double(problem.points[i]) + translation_d(pose)
    return wp.vec3(float(q[0]), float(q[1]), float(q[2]))


@wp.func
def matched_pair(problem: Problem, i: int, pose: wp.mat44d, radius: float):
    """Return where point i's match is in the grid's order, -1 for none; e_i and M_i."""
    R = rotation_d(pose)
    Rt = wp.transpose(R)
    t = translation_d(pose)
    a = to_double(problem.points[i])
    j, _d2 = match_of(problem, i, in_world(problem, i, pose), radius)
    e = wp.vec3d()
    M = wp.mat33d()
    if j >= 0:
        e = Rt * (to_double(problem.grid.points[j]) - t) - a
        B = matrix_to_double(problem.grid_covariances[j])
        M = wp.inverse(Rt * B * R + matrix_to_double(problem.covariances[i]))
    return j, e, M


@wp.kernel
def _match(
    offset: int,
    problems: wp.array[Problem],
    pose: wp.array[wp.mat44d],
    radius: float,
    distances2: wp.array[float],
):
    i = offset + wp.tid()
    j, d2 = match_of(problems[0], i, in_world(problems[0], i, pose[0]), radius)
    distances2[i] = wp.where(j >= 0, d2, wp.inf)


def match_points(problem: Any, pose: Any, *, count: int, radius: float, distances2: Any, device: Any) -> None:
    """Find each frame point's squared distance, m^2, to the nearest map point; inf for none.

    Args:
        problem, pose: see :func:`linearisation`.
        count: the problem's points.
        radius: metres.
        distances2: [>= count] float, written.
    """
    launch_split(_match, count, inputs=[problem, pose, radius], outputs=[distances2], device=device)


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


def linearisation(
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
) -> Work:
    """Return what matches the points to the map and sums the normal equations H xi = g of the pairs.

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
    return sum_of_blocks(
        _linearise,
        block_count(count, device),
        inputs=[problem, stages, stage, points_per_block(device), pose],
        sums=sums,
        folded=folded,
        system=system,
        device=device,
    )


def sum_of_blocks(
    kernel: Any, rows: int, *, inputs: list[Any], sums: Any, folded: Any, system: Any, device: Any
) -> Work:
    """Return what writes a row of ``sums`` a block, and their sum."""
    work = [prepared_split(kernel, rows, inputs=inputs, outputs=[sums], device=device, min_piece=4)]
    if rows > FOLDED * 8:
        work.append(prepared(_fold, folded.shape, inputs=[sums, rows], outputs=[folded], device=device))
        sums, rows = folded, folded.shape[0]
    work.append(prepared(_reduce, SUMS, inputs=[sums, rows], outputs=[system], device=device))
    return in_turn(*work)
