# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: poses and points that agree best with where pictures show the points, by GTSAM.

One camera knows distances only from how far it has moved. Points that many pictures see from far apart tie
their scales together, which a map that is tracked and extended picture by picture cannot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64

PIXEL = 0.7
"""Standard deviation of a feature's place in a picture up to 480 pixels wide, pixels."""

_CAUCHY = 2.0
"""Standard deviations at which Cauchy's kernel halves an observation's weight."""

_FEWEST = 3
"""A point that fewer pictures see says nothing of what it is not told."""

_DISTANCE = 0.1
"""A point is known when two rays that differ as its do tell its distance to this share of it."""

GATES = (6.0,)
"""Observations farther from their point than so many standard deviations are left out, in each round."""

_LOOSE = 0.1, 0.15
"""Standard deviation of what tracking says of the motion from one view to the next, radians and as a share
of the scene's depth: it holds what too few points fix, and is outvoted elsewhere."""

_FIXED = 1e-5
"""Standard deviation of a pose that is to stay, metres and radians."""

_NEAREST = 1e-3
"""A point so near before a camera, metres, or behind it, is none."""

_ITERATIONS, _TOLERANCE = 10, 1e-3


@dataclass(frozen=True)
class Observations:
    """Where views show points.

    Attributes:
        views, points: [m] numbers. pixels: [m, 2] (u, v).
    """

    views: NDArray[np.intp]
    points: NDArray[np.intp]
    pixels: Float64

    def only(self, rows: NDArray[np.bool_]) -> Observations:
        """Return those of the ``rows`` [m]."""
        return Observations(self.views[rows], self.points[rows], self.pixels[rows])


def triangulate_points(camera: Camera, poses: Float64, seen: Observations, count: int) -> Float64:
    """Return the points [count, 3] nearest to the rays of all views, nan where these are all but parallel.

    Args:
        poses: [n, 4, 4] T_wc of the views.
    """
    rays = camera.rays(seen.pixels[:, 0], seen.pixels[:, 1])
    rays = np.einsum(
        "mij,mj->mi", poses[seen.views, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True)
    )
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, seen.points, across)
    np.add.at(b, seen.points, np.einsum("mij,mj->mi", across, poses[seen.views, :3, 3]))
    number = np.bincount(seen.points, minlength=count)
    # Of two rays that differ by a small angle t the smallest eigenvalue is t^2 / 2.
    parallax = _pixel(camera) / camera.fx / _DISTANCE
    known = np.linalg.eigvalsh(A)[:, 0] > number * parallax**2 / 4.0
    points = np.full((count, 3), np.nan)
    points[known] = np.linalg.solve(A[known], b[known][..., None])[..., 0]
    return points


def reprojection_errors(camera: Camera, poses: Float64, points: Float64, seen: Observations) -> Float64:
    """Return [m] how far each observation is from its point, pixels; inf behind the camera or where nan."""
    local = np.einsum("mji,mj->mi", poses[seen.views, :3, :3], points[seen.points] - poses[seen.views, :3, 3])
    z = local[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        at = local[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        errors = np.linalg.norm(at - seen.pixels, axis=1)
        return np.where(np.isfinite(errors) & (z > _NEAREST), errors, np.inf)


def adjust_bundle(
    camera: Camera,
    poses: Float64,
    seen: Observations,
    count: int,
    *,
    fixed: NDArray[np.bool_],
    depth: float,
    gates: tuple[float, ...] = GATES,
) -> tuple[Float64, Float64]:
    """Return poses [n, 4, 4] and points [count, 3] that agree best with what was seen.

    Args:
        poses: [n, 4, 4] T_wc of the views, in order, where to start.
        seen: where these views show ``count`` points.
        fixed: [n] which poses stay; one at least.
        depth: how far away the scene is, as the poses have it.
        gates: a round for each, see :data:`GATES`.

    Returns:
        The poses, and the points: nan where too few agree.
    """
    points = np.full((count, 3), np.nan)
    for gate in gates:
        points = triangulate_points(camera, poses, seen, count)
        near = reprojection_errors(camera, poses, points, seen) < gate * _pixel(camera)
        number = np.bincount(seen.points[near], minlength=count)
        points[number < _FEWEST] = np.nan
        kept = seen.only(near & (number >= _FEWEST)[seen.points])
        poses, points = _solve(camera, poses, points, kept, fixed, depth)
    return poses, points


def resect(camera: Camera, T_wc: Float64, points: Float64, pixels: Float64) -> tuple[Float64, int]:
    """Return the pose [4, 4] from which known points look most as a picture shows them, and how many do.

    Args:
        T_wc: [4, 4] where to start.
        points: [m, 3] world. pixels: [m, 2] where the picture shows them.
    """
    T_cw, deviation, centred = se3.inverse(T_wc), _pixel(camera), pixels - (camera.cx, camera.cy)

    def residuals(step: Float64) -> Float64:
        local = se3.transform_points(se3.se3_exp(step) @ T_cw, points)
        at = local[:, :2] / np.maximum(local[:, 2:], _NEAREST) * (camera.fx, camera.fy)
        return ((at - centred) / deviation).ravel()

    found = least_squares(residuals, np.zeros(6), loss="cauchy", f_scale=_CAUCHY, max_nfev=20)
    agree = np.linalg.norm(residuals(found.x).reshape(-1, 2), axis=1) < GATES[-1]
    return se3.inverse(se3.orthonormalised(se3.se3_exp(found.x) @ T_cw)), int(agree.sum())


def _pixel(camera: Camera) -> float:
    return PIXEL * max(camera.width, 480) / 480.0


def _solve(
    camera: Camera,
    poses: Float64,
    points: Float64,
    seen: Observations,
    fixed: NDArray[np.bool_],
    depth: float,
) -> tuple[Float64, Float64]:
    """Return the poses and points at the least error, from where they are."""
    import gtsam  # where it is needed: it takes a quarter of a second

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([_LOOSE[0], _LOOSE[1] * depth], 3))
    for number, T_wc in enumerate(poses):
        pose = gtsam.Pose3(T_wc)
        values.insert(number, pose)
        if fixed[number]:
            graph.add(gtsam.PriorFactorPose3(number, pose, anchor))
        if number and not (fixed[number] and fixed[number - 1]):
            motion = gtsam.Pose3(se3.inverse(poses[number - 1]) @ T_wc)
            graph.add(gtsam.BetweenFactorPose3(number - 1, number, motion, loose))
    used = np.unique(seen.points)
    first = len(poses)
    for point in used.tolist():
        values.insert(first + point, points[point])
    kernel: Any = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, _pixel(camera)))
    calibration = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    keys = (first + seen.points).tolist()
    for pixel, view, key in zip(seen.pixels, seen.views.tolist(), keys, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, view, key, calibration))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    moved = np.array([solution.atPose3(number).matrix() for number in range(first)], order="C")
    moved[fixed] = poses[fixed]
    found = np.full_like(points, np.nan)
    for point in used.tolist():
        found[point] = solution.atPoint3(first + point)
    return moved, found
