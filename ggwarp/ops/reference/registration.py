# SPDX-License-Identifier: Apache-2.0
"""Oracles of neighbour search, covariances and generalised ICP: NumPy float64, brute force."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ggwarp.geometry import se3

Array = NDArray[np.float64]


def k_nearest(points: ArrayLike, queries: ArrayLike, k: int) -> tuple[NDArray[np.int64], Array]:
    """Return indices [m, k] and squared distances [m, k] of the k nearest ``points`` [n, 3], nearest first.

    Ties go to the lower index; rows are filled up with -1 and inf when there are fewer points than k.
    """
    points, queries = np.asarray(points, np.float64), np.asarray(queries, np.float64)
    d2 = ((queries[:, None, :] - points[None, :, :]) ** 2).sum(-1)
    order = np.argsort(d2, axis=1, kind="stable")[:, :k]
    missing = ((0, 0), (0, max(0, k - points.shape[0])))
    return (
        np.pad(order, missing, constant_values=-1),
        np.pad(np.take_along_axis(d2, order, 1), missing, constant_values=np.inf),
    )


def ellipse(points: ArrayLike) -> tuple[Array, Array]:
    """Return axes [3, 3] (columns) and standard deviations [3], falling, of a set of ``points`` [k, 3]."""
    points = np.asarray(points, np.float64)
    d = points - points.mean(0)
    values, vectors = np.linalg.eigh(d.T @ d / max(len(points) - 1, 1))
    return vectors[:, ::-1], np.sqrt(np.maximum(values[::-1], 0.0))


def gicp_cost(
    T_wc: ArrayLike,
    points: ArrayLike,
    covariances: ArrayLike,
    targets: ArrayLike,
    target_covariances: ArrayLike,
    *,
    robust_scale: float = np.inf,
) -> float:
    """Return the (robust) cost of matched pairs.

    Args:
        T_wc: [4, 4] frame-to-world pose.
        points, covariances: [n, 3] and [n, 3, 3], camera frame.
        targets, target_covariances: [n, 3] and [n, 3, 3], world frame.
        robust_scale: Geman-McClure's scale, Mahalanobis units; inf: plain squares.
    """
    T = np.asarray(T_wc, np.float64)
    R, t = T[:3, :3], T[:3, 3]
    d = np.asarray(targets, np.float64) - np.asarray(points, np.float64) @ R.T - t
    M = np.linalg.inv(
        np.asarray(target_covariances, np.float64) + R @ np.asarray(covariances, np.float64) @ R.T
    )
    e2 = np.einsum("ni,nij,nj->n", d, M, d)
    return float((e2 / (1.0 + e2 / robust_scale**2)).sum())


def gicp_system(
    T_wc: ArrayLike,
    points: ArrayLike,
    covariances: ArrayLike,
    targets: ArrayLike,
    target_covariances: ArrayLike,
    *,
    robust_scale: float = np.inf,
) -> tuple[Array, Array]:
    """Return the Gauss-Newton system H [6, 6], g [6] of :func:`gicp_cost` for T_wc <- T_wc Exp(xi).

    H and g are those of half the cost: its gradient is -2 g, with M held at ``T_wc``.
    """
    T = np.asarray(T_wc, np.float64)
    R, t = T[:3, :3], T[:3, 3]
    H, g = np.zeros((6, 6)), np.zeros(6)
    for a, A, b, B in zip(
        np.asarray(points, np.float64),
        np.asarray(covariances, np.float64),
        np.asarray(targets, np.float64),
        np.asarray(target_covariances, np.float64),
        strict=True,
    ):
        M = np.linalg.inv(B + R @ A @ R.T)
        e = b - R @ a - t
        J = np.hstack([-R, R @ se3.hat(a)])
        w = 1.0 / (1.0 + (e @ M @ e) / robust_scale**2) ** 2
        H += w * J.T @ M @ J
        g -= w * J.T @ M @ e
    return H, g
