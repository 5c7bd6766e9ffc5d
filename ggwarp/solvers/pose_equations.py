# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a pose and of the exposures against several pictures, and their solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import se3
from ggwarp.types import Float64

POSE = 6
"""Numbers of a pose's change; those of the exposures follow."""

INDEPENDENCE = 0.03
"""Share of the pixels that count: the errors of neighbours are alike."""

_EXPOSURE_DEVIATION = 0.3
"""Expected deviation of an exposure's parameters from 0, one standard deviation."""


@dataclass(frozen=True)
class Prior:
    """What is known of a pose beforehand.

    Attributes:
        T_cw: [4, 4] world to camera.
        information: [6, 6] inverse covariance of tau in T_cw <- Exp(tau) T_cw.
    """

    T_cw: Float64
    information: Float64


@dataclass(frozen=True)
class System:
    """Normal equations for (tau, a, b) of one reference, without a prior.

    Attributes:
        H: [8, 8]. gradient: [8].
        cost: of colour, robust, a sum.
        pixels: whose colour is compared.
    """

    H: Float64
    gradient: Float64
    cost: float
    pixels: int

    @property
    def mean_cost(self) -> float:
        """Robust cost of a pixel, 0 to the robust scale squared; inf where none was compared."""
        return self.cost / self.pixels if self.pixels else float("inf")


def joint_equations(
    systems: Sequence[System],
    share: float,
    T_cw: Float64,
    exposures: Sequence[tuple[float, float]],
    prior: Prior | None,
) -> tuple[Float64, Float64]:
    """Return H [m, m] and gradient [m] for (tau, a_1, b_1, ... a_n, b_n): m = 6 + 2 n.

    Args:
        systems: one for each of n references, all of the same pose.
        share: pixels that one pixel stands for.
        T_cw: [4, 4] where they are.
        exposures: n of (a, b), where they are.
    """
    share = INDEPENDENCE * share
    size = POSE + 2 * len(systems)
    H, gradient = np.zeros((size, size)), np.zeros(size)
    precision = 1.0 / _EXPOSURE_DEVIATION**2
    for i, (system, exposure) in enumerate(zip(systems, exposures, strict=True)):
        brightness = [POSE + 2 * i, POSE + 2 * i + 1]
        own = [*range(POSE), *brightness]
        H[np.ix_(own, own)] += share * system.H
        gradient[own] += share * system.gradient
        H[brightness, brightness] += precision
        gradient[brightness] += precision * np.array(exposure)
    if prior is not None:
        H[:POSE, :POSE] += prior.information
        gradient[:POSE] += prior.information @ se3.se3_log(T_cw @ se3.inverse(prior.T_cw))
    return H, gradient


def gauss_newton_step(H: Float64, gradient: Float64, used: int) -> Float64:
    """Return the step [m] of the first ``used`` unknowns, 0 for the others; zeros where nothing fixes it.

    Args:
        H, gradient: [m, m] and [m], see :func:`joint_equations`.
    """
    step, diagonal = np.zeros(len(gradient)), range(len(gradient))
    steadied = H.copy()
    # A hundred-thousandth of the diagonal steadies directions that nothing fixes.
    steadied[diagonal, diagonal] *= 1.0 + 1e-5
    try:
        step[:used] = np.linalg.solve(steadied[:used, :used], -gradient[:used])
    except np.linalg.LinAlgError:
        return np.zeros(len(gradient))
    return step if np.isfinite(step).all() else np.zeros(len(gradient))


def pose_information(H: Float64) -> Float64:
    """Return what H [m, m] says of the pose, [6, 6], whatever the exposures are."""
    to_exposures = H[:POSE, POSE:]
    return H[:POSE, :POSE] - to_exposures @ np.linalg.solve(H[POSE:, POSE:], to_exposures.T)
