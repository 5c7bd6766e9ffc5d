# SPDX-License-Identifier: Apache-2.0
"""The stages of a frame's registration to the map, coarse to fine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggwarp.geometry.uncertainty import semidefinite
from ggwarp.solvers.registration import Cloud, Registrar, Registration, RegistrationStage, RegistrationTarget
from ggwarp.types import Float64

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

_LEAST_SCALE = 0.02
"""Residuals are not taken for smaller than this share of what covariances let expect."""

_CORRELATION = 1.5
"""How much larger the pose's deviation is than the 6x6 system says at the residuals' own scale: errors of
neighbours are alike, and those of frames that see the same."""


def register_coarse_to_fine(
    registrar: Registrar, cloud: Cloud, target: RegistrationTarget, T_start: Float64, spacing: float
) -> Registration:
    """Register from ``T_start`` [4, 4], and once more from there, by how far off most points lie then.

    What moves stands out by that: half the points lie on what stands still, and where motion is foreseen well
    they do so from the first.

    Args:
        spacing: between the points, metres.
    """
    fine = max(RADII[-1], REACH * spacing)
    scale = registrar.residual_scale(cloud, target, T_start, radius=fine)
    stages = coarse_to_fine_stages(spacing, scale)
    found = registrar.register(cloud, target, T_start, stages, across=False, residual_radius=fine)
    scale = found.residual_scale
    found = registrar.register(cloud, target, found.T_wc, coarse_to_fine_stages(spacing, scale)[-1:])
    return replace(found, residual_scale=scale)


def coarse_to_fine_stages(spacing: float, residual_scale: float = 1.0) -> list[RegistrationStage]:
    """Return the stages for points that lie ``spacing`` metres apart.

    Args:
        residual_scale: how large residuals are where the search starts; see
            :meth:`ggwarp.solvers.registration.Registrar.residual_scale`.
    """
    *coarse, fine = [max(radius, REACH * spacing) for radius in RADII]
    *coarse_iterations, fine_iterations = _ITERATIONS
    seen = _ROBUST_SCALE * max(residual_scale, _LEAST_SCALE)
    stages = [
        RegistrationStage(
            radius, n, _COARSE_TOLERANCE, min(_ROBUST_SCALE * radius / fine, seen), _COARSE_THINNING
        )
        for radius, n in zip(coarse, coarse_iterations, strict=True)
    ]
    return [*stages, RegistrationStage(fine, fine_iterations, _TOLERANCE, min(_ROBUST_SCALE, seen))]


def cell_size(spacing: float) -> float:
    """Return the size of a target's grid cells, metres, for clouds whose points lie ``spacing`` metres apart.

    Points without a match look through every cell in reach: a bound keeps these few.
    """
    return max(2.5 * spacing, RADII[0] / 8.0)


def scaled_information(registration: Registration) -> Float64:
    """Return what a registration of a frame says of the pose [6, 6], at its residuals' own scale."""
    across, scale = registration.across, registration.residual_scale
    if not (np.isfinite(across).all() and np.isfinite(scale)):
        return np.zeros((6, 6))
    return semidefinite(across) / (max(scale, _LEAST_SCALE) * _CORRELATION) ** 2
