# SPDX-License-Identifier: Apache-2.0
"""What the pairs of generalised ICP say at a pose: how large their residuals are, and what they fix of it."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.registration.gicp import (
    SUMS,
    Problem,
    StageSettings,
    block_count,
    matched_pair,
    points_per_block,
    robust_weight,
    sum_of_blocks,
    vec29d,
)
from ggwarp.kernels.rigid import matrix_to_double, to_double
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.kernel
def _residuals(
    offset: int,
    problems: wp.array[Problem],
    pose: wp.array[wp.mat44d],
    radius: float,
    residuals2: wp.array[float],
):
    i = offset + wp.tid()
    j, e, M = matched_pair(problems[0], i, pose[0], radius)
    residuals2[i] = wp.where(j >= 0, float(wp.dot(e, M * e)), wp.inf)


@wp.kernel
def _fix_across(
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
    total = vec29d()
    for i in range(block * per_block, wp.min((block + 1) * per_block, problem.points.shape[0])):
        j, e, M = matched_pair(problem, i, pose[0], settings.radius)
        if j >= 0:
            a = to_double(problem.points[i])
            e2 = wp.dot(e, M * e)
            P = wp.inverse(matrix_to_double(problem.covariances[i]))
            # The normal: the inverse's first axis, which is far ahead of the others.
            n = wp.vec3d(P[0, 0], P[1, 0], P[2, 0])
            if P[1, 1] > P[0, 0] and P[1, 1] >= P[2, 2]:
                n = wp.vec3d(P[0, 1], P[1, 1], P[2, 1])
            elif P[2, 2] > P[0, 0]:
                n = wp.vec3d(P[0, 2], P[1, 2], P[2, 2])
            n = wp.normalize(P * wp.normalize(P * wp.normalize(n)))
            precision = wp.dot(n, P * n)
            N = wp.outer(n, n)
            # The normal is known to its own covariance: what that adds to n n^T is nothing that was seen.
            tilt = (P - precision * N) / precision
            W = robust_weight(e2, scale2) * wp.dot(n, M * n) * (N - tilt)
            C = wp.skew(a)
            WC = W * C
            CWC = C * WC
            k = int(0)
            for r in range(3):
                for c in range(r, 3):
                    total[k] += W[r, c]
                    k += 1
                for c in range(3):
                    total[k] -= WC[r, c]
                    k += 1
            for r in range(3):
                for c in range(r, 3):
                    total[k] -= CWC[r, c]
                    k += 1
    for k in range(wp.static(SUMS)):
        sums[block, k] = total[k]


def pair_residuals(
    problem: Any, pose: Any, *, count: int, radius: float, residuals2: Any, device: Any
) -> None:
    """Measure each pair's residual e^T M e, in variances of what its covariances let expect.

    Args:
        problem, pose: see :func:`ggwarp.kernels.registration.gicp.linearisation`.
        count: the problem's points.
        radius: farthest match, metres.
        residuals2: [>= count] float, written; inf for a point without a match.
    """
    launch_split(_residuals, count, inputs=[problem, pose, radius], outputs=[residuals2], device=device)


def fix_across(
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
    """Sum what the pairs' surfaces say of the pose where they face, and nothing of what lies along them.

    Of each pair it is w (n^T M n) (n n^T - T), n being the normal of the frame's point and T the normal's
    covariance, by the point's: ellipses are held along their surfaces, and normals err, but neither fixes a
    pose before a wall.

    Args:
        problem, stages, stage, pose, sums, folded, device: see
            :func:`ggwarp.kernels.registration.gicp.linearisation`; all points are used.
        count: at least the problem's points.
        system: [SUMS] float64, written: as H there, the rest 0. Not positive definite where nothing is seen.
    """
    sum_of_blocks(
        _fix_across,
        block_count(count, device),
        inputs=[problem, stages, stage, points_per_block(device), pose],
        sums=sums,
        folded=folded,
        system=system,
        device=device,
    )()
