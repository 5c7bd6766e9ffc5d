# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP: correspondences, 6x6 system, damped solve, SE(3) update.

For matched a_i (frame, camera coordinates) and b_i (map, world coordinates) with covariances A_i, B_i:

    e_i = R^T (b_i - t) - a_i,    M_i = (R^T B_i R + A_i)^-1,    cost = sum rho(e_i^T M_i e_i)

and T_wc <- T_wc Exp(xi), xi = (v, w): de = -(v + w x a). Everything is expressed in the camera, whose points
lie around the origin, and summed in double precision, so that float32 points are enough for 0.01 mm.

The sums go point -> block of :data:`BLOCK` points -> system, each in a fixed order: the bits do not depend on
threads or device scheduling.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.launch import launch_split
from ggwarp.kernels.math import mat66d, vec6d
from ggwarp.kernels.neighbours import HashGrid, nearest_in_grid

wp.set_module_options({"enable_backward": False})

BLOCK = 32
"""Points that one thread sums."""

SUMS = 29
"""Numbers of a system: 21 of the upper triangle of H by rows, 6 of g, the robust cost, the matched pairs."""

_BLOCK = wp.constant(BLOCK)

vec29d = wp.types.vector(SUMS, wp.float64)


@wp.func
def _rotation(T: wp.mat44d) -> wp.mat33d:
    return wp.mat33d(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def _translation(T: wp.mat44d) -> wp.vec3d:
    return wp.vec3d(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def _to_double(p: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@wp.func
def _matrix_to_double(A: wp.mat33) -> wp.mat33d:
    return wp.mat33d(
        wp.float64(A[0, 0]), wp.float64(A[0, 1]), wp.float64(A[0, 2]),
        wp.float64(A[1, 0]), wp.float64(A[1, 1]), wp.float64(A[1, 2]),
        wp.float64(A[2, 0]), wp.float64(A[2, 1]), wp.float64(A[2, 2]),
    )  # fmt: skip


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
    q = _rotation(pose[0]) * _to_double(points[i]) + _translation(pose[0])
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


@wp.kernel
def _linearise(
    offset: int,
    points: wp.array[wp.vec3],
    covariances: wp.array[wp.mat33],
    grid: HashGrid,
    grid_covariances: wp.array[wp.mat33],
    pose: wp.array[wp.mat44d],
    matches: wp.array[int],
    robust_scale2: wp.float64,
    sums: wp.array2d[wp.float64],
):
    block = offset + wp.tid()
    R = _rotation(pose[0])
    Rt = wp.transpose(R)
    t = _translation(pose[0])
    total = vec29d()
    for i in range(block * _BLOCK, wp.min((block + 1) * _BLOCK, points.shape[0])):
        j = matches[i]
        if j >= 0:
            a = _to_double(points[i])
            e = Rt * (_to_double(grid.points[j]) - t) - a
            M = wp.inverse(
                Rt * _matrix_to_double(grid_covariances[j]) * R + _matrix_to_double(covariances[i])
            )
            Me = M * e
            e2 = wp.dot(e, Me)
            w = robust_weight(e2, robust_scale2)
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
def _reduce(sums: wp.array2d[wp.float64], blocks: int, system: wp.array[wp.float64]):
    k = wp.tid()
    total = wp.float64(0.0)
    for block in range(blocks):
        total += sums[block, k]
    system[k] = total


def block_count(n: int) -> int:
    """Return the rows of ``sums`` that ``n`` points need."""
    return (n + BLOCK - 1) // BLOCK


def linearise(
    points: Any,
    covariances: Any,
    grid: Any,
    grid_covariances: Any,
    pose: Any,
    matches: Any,
    *,
    robust_scale: float,
    sums: Any,
    system: Any,
    device: Any,
) -> None:
    """Sum the normal equations H xi = g of the matched pairs.

    Args:
        points: [n] wp.vec3, camera frame, metres.
        covariances: [n] wp.mat33, camera frame.
        grid: built :class:`HashGrid` of the map's points, world frame.
        grid_covariances: [m] wp.mat33, world frame, in the grid's order.
        pose: [1] wp.mat44d, T_wc.
        matches: [n] int from :func:`match_points`.
        robust_scale: Mahalanobis distance at which Geman-McClure halves a residual's share of the cost.
        sums: [>= block_count(n), SUMS] float64, scratch.
        system: [SUMS] float64, written; see :data:`SUMS`.
    """
    blocks = block_count(points.shape[0])
    launch_split(
        _linearise,
        blocks,
        inputs=[
            points,
            covariances,
            grid,
            grid_covariances,
            pose,
            matches,
            robust_scale * robust_scale,
        ],
        outputs=[sums],
        device=device,
        min_piece=8,
    )
    wp.launch(_reduce, dim=SUMS, inputs=[sums, blocks], outputs=[system], device=device)


@wp.func
def _solve(H: mat66d, g: vec6d) -> vec6d:
    """Cholesky; zero where the matrix is not positive definite."""
    L = mat66d()
    for r in range(6):
        for c in range(r + 1):
            s = H[r, c]
            for k in range(c):
                s -= L[r, k] * L[c, k]
            if r == c:
                if not (s > wp.float64(0.0)):
                    return vec6d()
                L[r, r] = wp.sqrt(s)
            else:
                L[r, c] = s / L[c, c]
    x = vec6d()
    for r in range(6):
        s = g[r]
        for k in range(r):
            s -= L[r, k] * x[k]
        x[r] = s / L[r, r]
    for b in range(6):
        r = 5 - b
        s = x[r]
        for k in range(r + 1, 6):
            s -= L[k, r] * x[k]
        x[r] = s / L[r, r]
    return x


@wp.func
def se3_exp(xi: vec6d) -> wp.mat44d:
    """Rigid motion of a twist (translation, rotation)."""
    v = wp.vec3d(xi[0], xi[1], xi[2])
    w = wp.vec3d(xi[3], xi[4], xi[5])
    one = wp.float64(1.0)
    theta2 = wp.dot(w, w)
    a = one - theta2 / wp.float64(6.0)
    b = wp.float64(0.5) - theta2 / wp.float64(24.0)
    c = one / wp.float64(6.0) - theta2 / wp.float64(120.0)
    if theta2 > wp.float64(1.0e-8):
        theta = wp.sqrt(theta2)
        half = wp.sin(wp.float64(0.5) * theta) / theta
        a = wp.sin(theta) / theta
        b = wp.float64(2.0) * half * half
        c = (theta - wp.sin(theta)) / (theta2 * theta)
    W = wp.skew(w)
    W2 = W * W
    eye = wp.identity(n=3, dtype=wp.float64)
    R = eye + a * W + b * W2
    t = (eye + b * W + c * W2) * v
    zero = wp.float64(0.0)
    return wp.mat44d(
        R[0, 0], R[0, 1], R[0, 2], t[0],
        R[1, 0], R[1, 1], R[1, 2], t[1],
        R[2, 0], R[2, 1], R[2, 2], t[2],
        zero, zero, zero, one,
    )  # fmt: skip


@wp.func
def orthonormalised(T: wp.mat44d) -> wp.mat44d:
    """One Newton step towards the nearest rotation: undoes the rounding of many updates."""
    R = _rotation(T)
    S = wp.float64(1.5) * wp.identity(n=3, dtype=wp.float64) - wp.float64(0.5) * (wp.transpose(R) * R)
    R = R * S
    for r in range(3):
        for c in range(3):
            T[r, c] = R[r, c]
    return T


@wp.kernel
def _update(
    system: wp.array[wp.float64], damping: wp.float64, pose: wp.array[wp.mat44d], step: wp.array[wp.float64]
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
    xi = _solve(H, g)
    pose[0] = orthonormalised(pose[0] * se3_exp(xi))
    step[0] = wp.sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    step[1] = wp.sqrt(xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5])


def update_pose(system: Any, *, damping: float, pose: Any, step: Any, device: Any) -> None:
    """Solve (H + damping diag H) xi = g and set T_wc <- T_wc Exp(xi); a singular system leaves T_wc.

    Args:
        system: [SUMS] float64 from :func:`linearise`.
        damping: Levenberg-Marquardt's relative damping.
        pose: [1] wp.mat44d, T_wc, updated.
        step: [2] float64, written: |v| metres, |w| radians.
    """
    wp.launch(_update, dim=1, inputs=[system, damping], outputs=[pose, step], device=device)
