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

_HYPOTHESES = 400
"""With a third of the matches right, three right ones are drawn 15 times in so many."""

_INLIER_SHARE = 0.3
"""Matches that agree are at least so many of all."""

_INLIER = 3.0
"""A match agrees with a motion that leaves it within so many standard deviations."""

_PIXEL = 1.5
"""Standard deviation of a feature's place in a picture 480 pixels wide, pixels."""

_STEPS = 6
"""Gauss-Newton steps."""

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
        motions = kabsch(points_a[draws], points_b[draws])
        moved = points_b @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        errors2 = self._errors2(moved, pixels_a, points_a)
        counts = (errors2 < _INLIER**2).sum(axis=1)
        T = motions[int(counts.argmax())]
        inliers = errors2[int(counts.argmax())] < _INLIER**2
        information = np.zeros((6, 6))
        for _ in range(_STEPS):
            if inliers.sum() < 3:
                return None
            T, information = self._step(T, pixels_a[inliers], points_a[inliers], points_b[inliers])
            inliers = self._errors2(se3.transform_points(T, points_b), pixels_a, points_a) < _INLIER**2
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

    def _residuals(self, moved: Float64, pixels_a: Float64, points_a: Float64) -> Float64:
        """Return [..., m, 3] what is left of each match, in standard deviations: u, v, depth."""
        c = self._camera
        z = np.maximum(moved[..., 2], 0.05)
        u = c.fx * moved[..., 0] / z + c.cx - pixels_a[:, 0]
        v = c.fy * moved[..., 1] / z + c.cy - pixels_a[:, 1]
        w = (moved[..., 2] - points_a[:, 2]) / self._deviation(points_a)
        return np.stack([u / self._pixel, v / self._pixel, w], axis=-1)

    def _deviation(self, points_a: Float64) -> Float64:
        """Return [m] the standard deviation of the difference of two depths, metres."""
        return np.sqrt(2.0) * self._depth_noise(points_a[:, 2])

    def _errors2(self, moved: Float64, pixels_a: Float64, points_a: Float64) -> Float64:
        errors2 = (self._residuals(moved, pixels_a, points_a) ** 2).sum(axis=-1) / 3.0
        return np.where(moved[..., 2] > 0.05, errors2, np.inf)

    def _step(
        self, T: Float64, pixels_a: Float64, points_a: Float64, points_b: Float64
    ) -> tuple[Float64, Float64]:
        """One step of Gauss-Newton; return the motion [4, 4] and the information [6, 6] before it."""
        c = self._camera
        moved = se3.transform_points(T, points_b)
        residuals = self._residuals(moved, pixels_a, points_a)
        x, y, z = moved.T
        z = np.maximum(z, 0.05)
        zero = np.zeros_like(z)
        by_moved = np.stack(
            [
                np.stack([c.fx / z, zero, -c.fx * x / z**2], axis=1) / self._pixel,
                np.stack([zero, c.fy / z, -c.fy * y / z**2], axis=1) / self._pixel,
                np.stack([zero, zero, 1.0 / self._deviation(points_a)], axis=1),
            ],
            axis=1,
        )  # [m, 3, 3]
        # moved = R (b + v + w x b) + t for a twist (v, w) in the second camera.
        hats = np.zeros((len(points_b), 3, 3))
        bx, by, bz = points_b.T
        hats[:, 0, 1], hats[:, 0, 2], hats[:, 1, 2] = -bz, by, -bx
        hats -= hats.transpose(0, 2, 1)
        J = by_moved @ np.concatenate([np.broadcast_to(T[:3, :3], hats.shape), -T[:3, :3] @ hats], axis=2)
        weights = 1.0 / (1.0 + (residuals**2).sum(axis=-1) / _INLIER**2) ** 2  # Geman-McClure
        H = np.einsum("mki,m,mkj->ij", J, weights, J)
        g = np.einsum("mki,m,mk->i", J, weights, residuals)
        return T @ se3.se3_exp(-np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), g)), H


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
