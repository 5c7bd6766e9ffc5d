# SPDX-License-Identifier: Apache-2.0
"""Planes through Gaussians that lie on surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32, Float64

_TRIALS = 400
_AGREEMENT = 0.9  # cosine between a Gaussian's normal and its plane's
_SKIN = 3.0  # a plane's noise reaches so many times as far as its own points


@dataclass(frozen=True)
class Plane:
    """A plane with coordinates of its own: x = origin + a u + b v + c normal.

    Attributes:
        origin: [3] a point on it, metres, world frame.
        axes: [3, 3] u, v and the normal as columns, a rotation.
    """

    origin: Float64
    axes: Float64

    @property
    def normal(self) -> Float64:
        """[3] unit normal."""
        return self.axes[:, 2]

    def coordinates(self, points: NDArray[np.floating]) -> Float64:
        """Return [n, 3] (a, b, c) of ``points`` [n, 3]: along u, along v, above the plane, metres."""
        return (np.asarray(points, np.float64) - self.origin) @ self.axes

    def points(self, coordinates: NDArray[np.floating]) -> Float64:
        """Return [n, 3] the points of the plane with (a, b) = ``coordinates`` [n, 2]."""
        return self.origin + np.asarray(coordinates, np.float64) @ self.axes[:, :2].T

    def depths(self, rays: Float64, centre: Float64) -> Float64:
        """Return [n] how far along ``rays`` [n, 3] from ``centre`` [3] they meet the plane; inf: never."""
        slope = rays @ self.normal
        meets = np.abs(slope) > 1e-6
        along = np.divide(
            (self.origin - centre) @ self.normal, slope, out=np.full(len(rays), np.inf), where=meets
        )
        return np.where(along > 0.0, along, np.inf)


def fit_planes(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    weights: NDArray[np.floating],
    *,
    reach: float,
    least: int,
    most: int,
    towards: Float64,
    seed: int = 0,
) -> list[tuple[Plane, NDArray[np.bool_]]]:
    """Find the planes that most of ``points`` lie on, one after another (RANSAC).

    Args:
        points: [n, 3] metres.
        normals: [n, 3] unit normals of the surface there, of either sign.
        weights: [n] how much each counts.
        reach: a point belongs to a plane nearer than this, metres, with a normal within 26 degrees.
        least: planes with fewer points are not reported.
        most: planes reported at most.
        towards: [3] the planes' normals point to the side of this.

    Returns:
        Each plane with [n] the points that are its own, the heaviest plane first.
    """
    rng = np.random.default_rng(seed)
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    weights = np.asarray(weights, np.float64)
    free = np.ones(len(points), bool)
    found: list[tuple[Plane, NDArray[np.bool_]]] = []
    while len(found) < most and free.sum() >= least:
        index = np.nonzero(free)[0]
        trials = rng.choice(index, min(_TRIALS, len(index)), replace=False)
        scores = [
            weights[free & _near(points, normals, points[i], normals[i], reach)].sum()
            for i in trials.tolist()
        ]
        best = int(trials[int(np.argmax(scores))])
        origin, normal = points[best], normals[best]
        for _ in range(3):
            own = free & _near(points, normals, origin, normal, reach)
            if own.sum() < 3:
                break
            origin, normal = _least_squares(points[own], weights[own])
        own = free & _near(points, normals, origin, normal, reach)
        if own.sum() < least:
            break
        if (towards - origin) @ normal < 0.0:
            normal = -normal
        found.append((Plane(origin, _axes(normal)), own))
        # What is left of a rough surface must not become a second plane beside the first.
        free &= ~_near(points, normals, origin, normal, _SKIN * reach)
    return found


def surface_normals(gaussians: Gaussians) -> Float32:
    """Return [n, 3] the direction in which each Gaussian is thinnest: its normal, of either sign."""
    w, x, y, z = gaussians.quats.T
    columns = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
            np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
            np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )
    return columns[np.arange(len(columns)), gaussians.log_scales.argmin(axis=1)]


def _near(
    points: Float64, normals: Float64, origin: Float64, normal: Float64, reach: float
) -> NDArray[np.bool_]:
    return (np.abs((points - origin) @ normal) < reach) & (np.abs(normals @ normal) > _AGREEMENT)


def _least_squares(points: Float64, weights: Float64) -> tuple[Float64, Float64]:
    """Return the centre of ``points`` [n, 3] and the direction in which they spread least."""
    origin = np.average(points, axis=0, weights=weights)
    spread = np.cov(points, rowvar=False, aweights=weights)
    return origin, np.linalg.eigh(spread).eigenvectors[:, 0]


def _axes(normal: Float64) -> Float64:
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(normal, u), normal], axis=1).astype(np.float64)
