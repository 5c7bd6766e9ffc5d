# SPDX-License-Identifier: Apache-2.0
"""Two keyframes' surfaces laid on each other: what a loop found by its features must not contradict.

Features say where the camera is; surfaces, registered from there, say it again by other readings. Their word
is a veto and no more: what depth is biased by, tracking by depth has followed already.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.registration import covariance
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.registration import Cloud, Registrar, RegistrationTarget, build_target
from ggwarp.solvers.registration_stages import (
    RADII,
    cell_size,
    register_coarse_to_fine,
    scaled_information,
)
from ggwarp.types import Float32, Float64, FramePoints

_KEPT = 1500
"""Points of a keyframe that are kept, at least, where there are so many: 40 bytes each, for a veto."""

_LEAST_SHARED = 0.2
"""Share of a keyframe's points that have another's near, at least: as many as tracking asks of a frame."""

_DISAGREEMENT = 22.5
"""Squared Mahalanobis distance of six numbers that one in a thousand exceeds by chance."""


@state_value
@dataclass(frozen=True)
class Surface:
    """A keyframe's points, thinned.

    Attributes:
        points, quats, spreads: [n, 3], [n, 4], [n, 3]; see :class:`ggwarp.types.FramePoints`.
        spacing: median distance of neighbours, metres.
    """

    points: Float32
    quats: Float32
    spreads: Float32
    spacing: float

    @classmethod
    def of(cls, seen: FramePoints) -> Surface:
        """Return the surface of a frame's points, of which there is at least one."""
        return _thinned(seen.points, seen.quats, seen.spreads)

    @classmethod
    def shown_by(cls, depth: Float32, camera: Camera, config: ObservationConfig, *, device: Any) -> Surface:
        """Return the surface of a depth image [h, w] of ``camera``, metres, 0 = none."""
        seen = observe(depth, camera, config, device=device)
        return _thinned(*(to_host(rows) for rows in (seen.cloud.points, seen.quats, seen.spreads)))


def _thinned(points: Float32, quats: Float32, spreads: Float32) -> Surface:
    step = max(1, len(points) // _KEPT)
    points, quats, spreads = (rows[::step].copy() for rows in (points, quats, spreads))
    spacing = 0.0
    if len(points) > 1:
        distances, _ = KDTree(points).query(points, k=2, workers=1)
        spacing = float(np.median(distances[:, 1]))
    return Surface(points, quats, spreads, spacing)


def _near(a: Surface, b: Surface, T_ab: Float64) -> Surface:
    """Return the part of ``b`` that has points of ``a`` near."""
    distances, _ = KDTree(a.points).query(se3.transform_points(T_ab, b.points), workers=1)
    near = distances <= RADII[0]
    return replace(b, points=b.points[near], quats=b.quats[near], spreads=b.spreads[near])


class SurfaceRegistration(Stateful):
    """Lays keyframes' surfaces on each other."""

    STATE = ("_registrar",)

    def __init__(self, *, device: Any) -> None:
        self._device = device
        self._registrar = Registrar(device=device)

    def agree(self, a: Surface, b: Surface, T_ab: Float64, information: Float64) -> bool:
        """Return whether the surfaces can be laid on each other, and are then where features say.

        Args:
            T_ab: [4, 4] from the camera of ``b`` to that of ``a``, by features.
            information: [6, 6] inverse covariance of a twist in the second camera, positive definite.
        """
        shared = _near(a, b, T_ab)
        if len(shared.points) < _LEAST_SHARED * len(b.points):
            return False
        spacing = max(a.spacing, b.spacing)
        found = register_coarse_to_fine(self._registrar, self._cloud(shared), self._target(a), T_ab, spacing)
        if not np.isfinite(found.residual_scale):
            return False  # fewer than half of the points near have a match
        surfaces = scaled_information(found)
        joint = surfaces + information
        apart = se3.se3_log(se3.inverse(T_ab) @ found.T_wc)
        step = np.linalg.solve(joint, surfaces @ apart)
        # (S^-1 + I^-1)^-1, also where surfaces leave a direction open.
        return bool(apart @ surfaces @ (apart - step) <= _DISAGREEMENT)

    def _cloud(self, surface: Surface) -> Cloud:
        points, quats, spreads = self._arrays(surface)
        matrix: Any = wp.mat33
        covariances = wp.empty(len(surface.points), dtype=matrix, device=self._device)
        covariance.build_covariances(quats, spreads, covariances=covariances, device=self._device)
        return Cloud(points, covariances)

    def _target(self, surface: Surface) -> RegistrationTarget:
        size = cell_size(surface.spacing)
        return build_target(*self._arrays(surface), cell_size=size, device=self._device)

    def _arrays(self, surface: Surface) -> list[Any]:
        columns = ((surface.points, wp.vec3), (surface.quats, wp.vec4), (surface.spreads, wp.vec3))
        return [wp.array(rows, dtype=dtype, device=self._device) for rows, dtype in columns]
