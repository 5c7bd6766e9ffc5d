# SPDX-License-Identifier: Apache-2.0
"""The motion between two keyframes by their surfaces: what a loop found by its features must agree with.

Features say where the camera is; surfaces, registered from there, say it again by other readings, and how
well. Two views of which less than half can be laid on each other show different places, or too little of the
same one.
"""

from __future__ import annotations

from dataclasses import dataclass
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
from ggwarp.solvers.registration_stages import RADII, register_coarse_to_fine, scaled_information
from ggwarp.types import Float32, Float64, FramePoints

_KEPT = 4000
"""Points of a keyframe that are kept, about: as many again would say little more."""

_CELL_SPACINGS = 2.5
"""Size of the search grid's cells, spacings."""

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
    points, quats, spreads = (rows[::step] for rows in (points, quats, spreads))
    spacing = 0.0
    if len(points) > 1:
        distances, _ = KDTree(points).query(points, k=2, workers=1)
        spacing = float(np.median(distances[:, 1]))
    return Surface(points, quats, spreads, spacing)


class SurfaceRegistration(Stateful):
    """Lays keyframes' surfaces on each other."""

    STATE = ("_registrar",)

    def __init__(self, *, device: Any) -> None:
        self._device = device
        self._registrar = Registrar(device=device)

    def refine(
        self, a: Surface, b: Surface, T_ab: Float64, information: Float64
    ) -> tuple[Float64, Float64] | None:
        """Return the motion [4, 4] by surfaces and by what is known of it, and the information [6, 6] then.

        None where fewer than half the points of ``b`` lie on ``a``, or where they contradict what is known.

        Args:
            T_ab: [4, 4] where features say that it is.
            information: [6, 6] inverse covariance of a twist in the second camera, positive definite.
        """
        spacing = max(a.spacing, b.spacing)
        found = register_coarse_to_fine(self._registrar, self._cloud(b), self._target(a), T_ab, spacing)
        if not np.isfinite(found.residual_scale):
            return None  # fewer than half the points have a match
        surfaces = scaled_information(found)
        joint = surfaces + information
        apart = se3.se3_log(se3.inverse(T_ab) @ found.T_wc)
        step = np.linalg.solve(joint, surfaces @ apart)
        # (S^-1 + I^-1)^-1, also where surfaces leave a direction open.
        if apart @ surfaces @ (apart - step) > _DISAGREEMENT:
            return None
        return T_ab @ se3.se3_exp(step), joint

    def _cloud(self, surface: Surface) -> Cloud:
        points, quats, spreads = self._arrays(surface)
        matrix: Any = wp.mat33
        covariances = wp.empty(len(surface.points), dtype=matrix, device=self._device)
        covariance.build_covariances(quats, spreads, covariances=covariances, device=self._device)
        return Cloud(points, covariances)

    def _target(self, surface: Surface) -> RegistrationTarget:
        # As for tracking: points without a match look through every cell in reach.
        cell_size = max(_CELL_SPACINGS * surface.spacing, RADII[0] / 8.0)
        return build_target(*self._arrays(surface), cell_size=cell_size, device=self._device)

    def _arrays(self, surface: Surface) -> list[Any]:
        columns = ((surface.points, wp.vec3), (surface.quats, wp.vec4), (surface.spreads, wp.vec3))
        return [wp.array(rows, dtype=dtype, device=self._device) for rows, dtype in columns]
