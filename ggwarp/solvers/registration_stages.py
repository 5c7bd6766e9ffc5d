# SPDX-License-Identifier: Apache-2.0
"""The stages of a frame's registration to the map, coarse to fine."""

from __future__ import annotations

from ggwarp.solvers.registration import RegistrationStage

REACH = 1.5
"""No search for a match ends below so many spacings of points: sparse points always leave a gap."""

RADII = (0.3, 0.1, 0.03)
"""Farthest match of each stage, coarse to fine, metres; at least ``REACH`` spacings of points."""

_ITERATIONS = (6, 6, 15)
"""Linearisations of each stage at most."""

_COARSE_THINNING = 4
"""All stages but the last use every fourth point."""

_COARSE_TOLERANCE, _TOLERANCE = 1e-3, 1e-4
"""A coarse stage, and the last one, ends when a step is smaller, metres and radians."""

_ROBUST_SCALE = 3.0
"""Standard deviations at which Geman-McClure's kernel halves a residual's share of the cost in the last
stage; wider in coarse stages, in the ratio of their radii."""


def coarse_to_fine_stages(spacing: float) -> list[RegistrationStage]:
    """Return the stages for points that lie ``spacing`` metres apart."""
    *coarse, fine = [max(radius, REACH * spacing) for radius in RADII]
    *coarse_iterations, fine_iterations = _ITERATIONS
    stages = [
        RegistrationStage(radius, n, _COARSE_TOLERANCE, _ROBUST_SCALE * radius / fine, _COARSE_THINNING)
        for radius, n in zip(coarse, coarse_iterations, strict=True)
    ]
    return [*stages, RegistrationStage(fine, fine_iterations, _TOLERANCE, _ROBUST_SCALE)]
