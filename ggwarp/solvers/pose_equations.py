# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a pose and of the exposures against several pictures: what they say of the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggwarp.types import Float64

POSE = 6
"""Numbers of a pose's change; those of the exposure follow."""

INDEPENDENCE = 0.03
"""Share of the pixels that count: the errors of neighbours are alike."""

EXPOSURE_PRECISION = 1.0 / 0.3**2
"""Inverse variance of an exposure's parameters about 0, expected."""


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


def pose_information(systems: Sequence[System], prior: Prior | None) -> Float64:
    """Return what systems of one pose and a prior say of it, [6, 6], whatever the exposures are."""
    information = np.zeros((POSE, POSE)) if prior is None else np.array(prior.information, np.float64)
    for system in systems:
        H = INDEPENDENCE * system.H
        mixed, exposure = H[:POSE, POSE:], H[POSE:, POSE:] + EXPOSURE_PRECISION * np.eye(2)
        information += H[:POSE, :POSE] - mixed @ np.linalg.solve(exposure, mixed.T)
    return information
