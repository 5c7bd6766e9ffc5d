# SPDX-License-Identifier: Apache-2.0
"""The pose graph: keyframes' poses that agree best with all motions measured between them, by GTSAM.

Every motion has the covariance that its measurement states and a robust kernel: tracking that has slid and
a place taken for another are outvoted, not averaged in.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ggwarp.runtime.state import state_value
from ggwarp.types import Float64

_CAUCHY = 3.0
"""Standard deviations at which Cauchy's kernel halves a motion's weight."""

_ANCHOR = 1e-4
"""Standard deviation of the first pose, metres and radians: the world stays where it is."""

_ITERATIONS = 30

_TOLERANCE = 1e-4
"""The solution is found when a step lowers the error by a smaller share."""

_SINGULAR = 1e-10
"""An information whose smallest eigenvalue is a smaller share of the largest leaves a direction open."""

_GTSAM_ORDER = np.array([3, 4, 5, 0, 1, 2])
"""GTSAM's twists are (rotation, translation)."""

MISSING = "GTSAM is not installed"


def solver_is_there() -> bool:
    """Return whether GTSAM is installed."""
    return importlib.util.find_spec("gtsam") is not None


@state_value
@dataclass(frozen=True)
class MeasuredMotion:
    """A motion measured between two keyframes.

    Attributes:
        a, b: their numbers, a < b.
        T_ab: [4, 4] from the camera of b to that of a.
        covariance: [6, 6] of a twist (translation, rotation) in the camera of b.
    """

    a: int
    b: int
    T_ab: Float64
    covariance: Float64


def is_positive(information: Float64) -> bool:
    """Return whether ``information`` [6, 6] is finite and fixes all of a motion: it has an inverse."""
    if not np.isfinite(information).all():
        return False
    values = np.linalg.eigvalsh(information)
    return bool(values[0] > _SINGULAR * values[-1])


def optimise_poses(poses: Float64, motions: Sequence[MeasuredMotion], *, fixed: int = 1) -> Float64:
    """Return the poses T_wc [n, 4, 4] that agree best with the ``motions``, the first ``fixed`` as they are.

    Args:
        poses: [n, 4, 4], where to start; every one must hang together with the fixed ones by motions.
    """
    import gtsam  # at the first loop: it takes a quarter of a second

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, T_wc in enumerate(poses):
        values.insert(number, gtsam.Pose3(T_wc))
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR)
    for number in range(fixed):
        graph.add(gtsam.PriorFactorPose3(number, gtsam.Pose3(poses[number]), anchor))
    kernel: Any = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    for motion in motions:
        covariance = motion.covariance[np.ix_(_GTSAM_ORDER, _GTSAM_ORDER)]
        noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(covariance))
        graph.add(gtsam.BetweenFactorPose3(motion.a, motion.b, gtsam.Pose3(motion.T_ab), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    # GTSAM's matrices lie by columns, a restored state's by rows: products would differ in their last bits.
    return np.array([solution.atPose3(number).matrix() for number in range(len(poses))], order="C")
