# SPDX-License-Identifier: Apache-2.0
"""How densely Gaussians lie on the surface that a camera sees."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.seeding.surface_count import count_on_surface, mean_over_surface
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.types import Float64

_RADIUS = 2
"""Pixels to each side within which Gaussians are counted: at three in ten pixels seven or eight of them."""


def surface_density(
    gaussians: GaussianMap, T_wc: Float64, camera: Camera, depth: Any, *, tolerance: float
) -> Any:
    """Return [h, w] float, how many Gaussians a pixel lie on the surface at ``depth``, as a mean nearby.

    Those behind the surface or in front of it are not counted; nor is area without depth.

    Args:
        T_wc: [4, 4] the pose of ``camera``.
        depth: [h, w] float, metres, 0 = none; on the map's device, as the result is.
        tolerance: a Gaussian lies on the surface where its depth differs by no more than this share of it.
    """
    device = gaussians.device
    T_cw = se3.inverse(T_wc).astype(np.float32)
    counts: Any = wp.empty(depth.shape, dtype=int, device=device)
    density: Any = wp.empty(depth.shape, dtype=float, device=device)
    count_on_surface(
        gaussians.fields["means"],
        count=gaussians.count,
        T_cw=wp.array(T_cw[None], dtype=wp.mat44, device=device),
        camera=intrinsics_of(camera),
        depth=depth,
        tolerance=tolerance,
        counts=counts,
        device=device,
    )
    mean_over_surface(
        counts, depth=depth, radius=_RADIUS, tolerance=tolerance, density=density, device=device
    )
    return density
