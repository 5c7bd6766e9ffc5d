# SPDX-License-Identifier: Apache-2.0
"""The motion between two keyframes from matched features with depth: RANSAC, then least squares.

Three matches give a motion (Kabsch); the one that most matches agree with is refined on these. A match's
error is that of its pixels, which are known well, and of its depth, which is not: it is measured in standard
deviations of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.features import Features, match_features
from ggwarp.pipeline.loops.pose_graph import is_positive
from ggwarp.types import Float64

DepthNoise = Callable[[Any], Any]
"""Depths, metres -> their standard deviations, metres."""

_HYPOTHESES, _RIGHT = 400, 15
"""So many are drawn at most, and no more where three right matches were drawn so often, as far as the best
hypothesis tells: with a third of the matches right, that is in all of them."""

_AT_ONCE = 100
"""Hypotheses that are looked at together."""

_INLIER_SHARE = 0.3
"""Matches that agree are at least so many of all."""

_INLIER = 3.0
"""A match agrees with a motion that leaves it within so many standard deviations."""

_PIXEL = 1.5
"""Standard deviation of a feature's place in a picture 480 pixels wide, pixels."""

_STEPS, _SETTLED = 6, 0.01
"""Gauss-Newton steps at most, and the last: one that is smaller, in standard deviations of the motion."""

_NEAR = 0.05
"""What lies nearer is not seen, metres."""

_CORRELATION = 0.1
"""The share of its matches' information that a motion is given: the depths of one picture err together, and
so do features that lie together."""


@dataclass(frozen=True)
class FeatureAlignment:
    """What matched features say of the motion between two keyframes.

    Attributes:
        T_ab: [4, 4] from the camera of the second keyframe to that of the first.
        information: [6, 6] inverse covariance of a twist (translation, rotation) in the second camera.
        inliers: [m] which matches agree.
    """

    T_ab: Float64
    information: Float64
    inliers: NDArray[np.bool_]

    @property
    def count(self) -> int:
        return int(self.inliers.sum())


class FeatureAligner:
    """Aligns features of pictures by one camera."""

    def __init__(self, camera: Camera, depth_noise: DepthNoise) -> None:
        self._camera, self._depth_noise = camera, depth_noise
        self._pixel = _PIXEL * max(camera.width, 480) / 480.0

    def align(
        self, pixels_a: Float64, points_a: Float64, points_b: Float64, *, seed: tuple[int, ...]
    ) -> FeatureAlignment | None:
        """Return the motion that most matches agree with; None where fewer than three do.

        Args:
            pixels_a, points_a: [m, 2] and [m, 3] the matched features in the first keyframe.
            points_b: [m, 3] the same in the second keyframe's camera.
            seed: of the random draws.
        """
        m = len(points_a)
        if m < 3:
            return None
        rng = np.random.default_rng(seed)
        draws = rng.integers(m, size=(_HYPOTHESES, 3))
        draws = draws[
            (draws[:, 0] != draws[:, 1]) & (draws[:, 1] != draws[:, 2]) & (draws[:, 0] != draws[:, 2])
        ]
        if not len(draws):
            return None
        T, most = np.eye(4), 0
        for begin in range(0, len(draws), _AT_ONCE):
            some = draws[begin : begin + _AT_ONCE]
            motions = kabsch(points_a[some], points_b[some])
            counts = self._supporters(motions, pixels_a, points_a, points_b)
            if counts.max() > most:
                T, most = motions[int(counts.argmax())], int(counts.max())
            if (begin + len(some)) * (most / m) ** 3 >= _RIGHT:
                break
        inliers = self._errors2(se3.transform_points(T, points_b), pixels_a, points_a) < _INLIER**2
        information = np.zeros((6, 6))
        for _ in range(_STEPS):
            if inliers.sum() < 3:
                return None
            some = pixels_a[inliers], points_a[inliers], points_b[inliers]
            T, information, settled = self._step(T, *some)
            inliers = self._errors2(se3.transform_points(T, points_b), pixels_a, points_a) < _INLIER**2
            if settled:
                break
        return FeatureAlignment(T, _CORRELATION * information, inliers)

    def align_features(
        self, one: Features, other: Features, *, least: int, seed: tuple[int, ...]
    ) -> FeatureAlignment | None:
        """Return the motion between two keyframes by their features; None where it is not fixed by these.

        Args:
            least: so many matches must agree, and three in ten.
            seed: of the random draws.
        """
        rows, columns = match_features(one, other).T
        if len(rows) < least:
            return None
        found = self.align(one.pixels[rows], one.points[rows], other.points[columns], seed=seed)
        if found is None or found.count < max(least, _INLIER_SHARE * len(rows)):
            return None
        return found if is_positive(found.information) else None  # features in a line or a spot

    def _supporters(
        self, motions: Float64, pixels_a: Float64, points_a: Float64, points_b: Float64
    ) -> NDArray[np.intp]:
        """Return [k] how many matches agree with each of ``motions`` [k, 4, 4], as by :meth:`_errors2`."""
        c, rows = self._camera, np.float32
        turned = motions[:, :3, :3].reshape(-1, 3).astype(rows) @ points_b.T.astype(rows)
        moved = turned.reshape(len(motions), 3, -1) + motions[:, :3, 3:].astype(rows)
        z = moved[:, 2]
        near = z <= _NEAR
        nearness = 1.0 / np.maximum(z, rows(_NEAR))
        errors2 = (z - points_a[:, 2].astype(rows)) / self._deviation(points_a).astype(rows)
        errors2 *= errors2
        for axis, focal, centre in ((0, c.fx, c.cx), (1, c.fy, c.cy)):
            error = moved[:, axis]
            error *= nearness
            error *= rows(focal / self._pixel)
            error -= ((pixels_a[:, axis] - centre) / self._pixel).astype(rows)
            error *= error
            errors2 += error
        return ((errors2 < 3.0 * _INLIER**2) & ~near).sum(axis=1)

    def _residuals(self, moved: Float64, pixels_a: Float64, points_a: Float64) -> Float64:
        """Return [3, m] what is left of each match, in standard deviations: u, v, depth."""
        c = self._camera
        z = np.maximum(moved[:, 2], _NEAR)
        u = c.fx * moved[:, 0] / z + c.cx - pixels_a[:, 0]
        v = c.fy * moved[:, 1] / z + c.cy - pixels_a[:, 1]
        w = (moved[:, 2] - points_a[:, 2]) / self._deviation(points_a)
        return np.stack([u / self._pixel, v / self._pixel, w])

    def _deviation(self, points_a: Float64) -> Float64:
        """Return [m] the standard deviation of the difference of two depths, metres."""
        return np.sqrt(2.0) * self._depth_noise(points_a[:, 2])

    def _errors2(self, moved: Float64, pixels_a: Float64, points_a: Float64) -> Float64:
        errors2 = (self._residuals(moved, pixels_a, points_a) ** 2).sum(axis=0) / 3.0
        return np.where(moved[:, 2] > _NEAR, errors2, np.inf)

    def _step(
        self, T: Float64, pixels_a: Float64, points_a: Float64, points_b: Float64
    ) -> tuple[Float64, Float64, bool]:
        """One step of Gauss-Newton; return the motion [4, 4], the information [6, 6] before it, and whether
        it was small."""
        c = self._camera
        moved = se3.transform_points(T, points_b)
        residuals = self._residuals(moved, pixels_a, points_a)
        nearness = 1.0 / np.maximum(moved[:, 2:], _NEAR)
        x, y = moved[:, :1] * nearness, moved[:, 1:2] * nearness
        # moved = R (b + v + w x b) + t for a twist (v, w) in the second camera.
        across, down, along = T[:3, :3]
        J = np.empty((3, len(points_b), 6))
        J[0, :, :3] = c.fx / self._pixel * nearness * (across - x * along)
        J[1, :, :3] = c.fy / self._pixel * nearness * (down - y * along)
        J[2, :, :3] = along / self._deviation(points_a)[:, None]
        for axis, after, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            J[:, :, 3 + axis] = points_b[:, after] * J[:, :, last] - points_b[:, last] * J[:, :, after]
        weights = 1.0 / (1.0 + (residuals**2).sum(axis=0) / _INLIER**2) ** 2  # Geman-McClure
        J, weighted = J.reshape(-1, 6), (J * weights[:, None]).reshape(-1, 6)
        H, g = J.T @ weighted, residuals.ravel() @ weighted
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), g)
        return T @ se3.se3_exp(step), H, bool(_CORRELATION * (step @ H @ step) < _SETTLED**2)


def kabsch(a: Float64, b: Float64) -> Float64:
    """Return [..., 4, 4] the rigid motions that bring points ``b`` [..., n, 3] closest to ``a``."""
    centre_a, centre_b = a.mean(axis=-2), b.mean(axis=-2)
    H = np.swapaxes(b - centre_b[..., None, :], -1, -2) @ (a - centre_a[..., None, :])
    U, _, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    flip = np.ones(H.shape[:-1])
    flip[..., 2] = np.where(sign < 0.0, -1.0, 1.0)
    R = np.swapaxes(Vt, -1, -2) @ (flip[..., :, None] * np.swapaxes(U, -1, -2))
    T = np.zeros((*H.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = centre_a - np.einsum("...ij,...j->...i", R, centre_b)
    T[..., 3, 3] = 1.0
    return T
