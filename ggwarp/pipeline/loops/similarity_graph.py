# SPDX-License-Identifier: Apache-2.0
"""Loops of one camera: the similarity between two views of a place, and the pose graph over Sim(3).

What tracking does not know, it loses: without depth that is the scale, too. The graph spreads it over the
views in between, by GTSAM (H. Strasdat, J. Montiel and A. Davison, RSS 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.feature_alignment import kabsch
from ggwarp.runtime.state import state_value
from ggwarp.types import Float64

_HYPOTHESES = 400
_ROUNDS = 3
"""The similarity of the matches that agree is taken so often."""

_PIXELS = 4.0
"""A match agrees with a similarity that leaves it within so many pixels of a picture 480 wide, either way."""

_DEPTH = 0.1
"""And that leaves its two depths within this share of each other."""

_CAUCHY = 3.0
"""Standard deviations at which Cauchy's kernel halves a measurement's weight."""

_ANCHOR = 1e-4
"""Standard deviation of the first view's similarity."""

_ITERATIONS, _TOLERANCE = 50, 1e-5


@state_value
@dataclass(frozen=True)
class MeasuredSimilarity:
    """A similarity measured between two views.

    Attributes:
        a, b: their numbers, a < b.
        S_ab: [4, 4] from the camera of b to that of a, whose scales differ.
        deviations: (rotation, radians; translation, metres of b; scale, as a share of it).
    """

    a: int
    b: int
    S_ab: Float64
    deviations: tuple[float, float, float]


def align_similarity(
    camera: Camera, points_a: Float64, points_b: Float64, *, seed: tuple[int, ...]
) -> tuple[Float64, NDArray[np.bool_]] | None:
    """Return the similarity S_ab [4, 4] that most matches agree with, and which these are; None: too few do.

    Args:
        points_a, points_b: [m, 3] matched points in the two cameras.
        seed: of the random draws.
    """
    m = len(points_a)
    if m < 3:
        return None
    draws = np.random.default_rng(seed).integers(m, size=(_HYPOTHESES, 3))
    a, b, c = draws.T
    draws = draws[(a != b) & (b != c) & (a != c)]
    if not len(draws):
        return None
    found = similarities(points_a[draws], points_b[draws])
    agree = _agree(camera, found, points_a, points_b)
    inliers = agree[int(agree.sum(axis=1).argmax())]
    S = np.eye(4)
    for _ in range(_ROUNDS):
        if inliers.sum() < 3:
            return None
        S = similarities(points_a[inliers], points_b[inliers])
        [inliers] = _agree(camera, S[None], points_a, points_b)
    return S, inliers


def similarities(a: Float64, b: Float64) -> Float64:
    """Return [..., 4, 4] the similarities that bring points ``b`` [..., n, 3] closest to ``a``.

    The scale is that of B. Horn (JOSA A 1987), alike in both directions: both have errors.
    """
    centre_a, centre_b = a.mean(axis=-2), b.mean(axis=-2)
    spread_a = ((a - centre_a[..., None, :]) ** 2).sum(axis=(-2, -1))
    spread_b = ((b - centre_b[..., None, :]) ** 2).sum(axis=(-2, -1))
    scale = np.sqrt(np.maximum(spread_a, 1e-18) / np.maximum(spread_b, 1e-18))
    S = kabsch(a, b * scale[..., None, None])
    S[..., :3, :3] *= scale[..., None, None]
    return S


def optimise_similarities(poses: Float64, measured: Sequence[MeasuredSimilarity]) -> Float64:
    """Return each view's similarity [n, 4, 4] to the world that agrees best; the first stays.

    Args:
        poses: [n, 4, 4] T_wc, where to start, at scale 1; all hang together by measurements.
    """
    import gtsam  # at the first loop: it takes a quarter of a second

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, T_wc in enumerate(poses):
        values.insert(number, _gtsam_similarity(T_wc))
    anchor = gtsam.noiseModel.Isotropic.Sigma(7, _ANCHOR)
    graph.add(gtsam.PriorFactorSimilarity3(0, _gtsam_similarity(poses[0]), anchor))
    kernel: Any = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    for one in measured:
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(one.deviations, (3, 3, 1)))
        noise = gtsam.noiseModel.Robust.Create(kernel, sigmas)
        graph.add(gtsam.BetweenFactorSimilarity3(one.a, one.b, _gtsam_similarity(one.S_ab), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    found = [solution.atSimilarity3(number) for number in range(len(poses))]
    return np.stack([_from_gtsam(one) for one in found])


def _agree(camera: Camera, S: Float64, points_a: Float64, points_b: Float64) -> NDArray[np.bool_]:
    """Return [k, m] which matches agree with the similarities ``S`` [k, 4, 4]."""
    gate = _PIXELS * max(camera.width, 480) / 480.0
    moved = points_b @ np.swapaxes(S[:, :3, :3], 1, 2) + S[:, None, :3, 3]
    back_S = np.linalg.inv(S)
    back = points_a @ np.swapaxes(back_S[:, :3, :3], 1, 2) + back_S[:, None, :3, 3]
    agree = np.abs(moved[..., 2] - points_a[:, 2]) < _DEPTH * points_a[:, 2]
    for found, true in ((moved, points_a), (back, points_b)):
        z = np.maximum(found[..., 2], 1e-6)
        off = [
            f * (found[..., k] / z - true[:, k] / true[:, 2]) for k, f in enumerate((camera.fx, camera.fy))
        ]
        agree &= (np.hypot(*off) < gate) & (found[..., 2] > 1e-6)
    return agree


def _gtsam_similarity(S: Float64) -> Any:
    """Return ``S`` [4, 4] as GTSAM has it: x -> s (R x + t)."""
    import gtsam

    T, scale = sim3.split(S)
    return gtsam.Similarity3(gtsam.Rot3(T[:3, :3]), T[:3, 3] / scale, scale)


def _from_gtsam(one: Any) -> Float64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = one.rotation().matrix(), one.scale() * np.asarray(one.translation())
    return sim3.similarity(se3.orthonormalised(T), one.scale())
