# SPDX-License-Identifier: Apache-2.0
"""What is known of a pose, as the inverse covariance of (translation, rotation)."""

from __future__ import annotations

import numpy as np

from ggwarp.types import Float64


def position_std(information: Float64) -> float:
    """Return the largest standard deviation of the position, metres; inf where it is not determined.

    Args:
        information: [6, 6] inverse covariance of (translation, rotation).
    """
    values, vectors = np.linalg.eigh(information)
    if not np.isfinite(values).all() or values[0] <= 1e-12 * max(values[-1], 1e-300):
        return float("inf")
    covariance = (vectors / values) @ vectors.T
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def semidefinite(information: Float64) -> Float64:
    """Return the nearest information [6, 6] that has no negative eigenvalue."""
    values, vectors = np.linalg.eigh(information)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def loosened(information: Float64, deviation: float) -> Float64:
    """Return the information [6, 6] on a pose after a random motion: metres, and twice as many radians."""
    if deviation <= 0.0:
        return information
    precision = np.diag([1.0] * 3 + [0.25] * 3) / deviation**2
    return precision - precision @ np.linalg.solve(information + precision, precision)
