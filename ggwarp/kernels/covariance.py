# SPDX-License-Identifier: Apache-2.0
"""A Gaussian for each point from its nearest neighbours: rotation and scale (GG-SLAM section 1a)."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.launch import launch_split
from ggwarp.kernels.math import eigen_symmetric, matrix_to_quat

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _estimate(
    offset: int,
    points: wp.array[wp.vec3],
    queries: wp.array[wp.vec3],
    neighbours: wp.array2d[int],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
):
    i = offset + wp.tid()
    # Offsets from the point itself: the moments of raw coordinates would cancel in float32.
    origin = queries[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for s in range(neighbours.shape[1]):
        j = neighbours[i, s]
        if j >= 0:
            total += points[j] - origin
            count += 1.0
    mean = total / wp.max(count, 1.0)
    moment = wp.mat33()
    for s in range(neighbours.shape[1]):
        j = neighbours[i, s]
        if j >= 0:
            d = points[j] - origin - mean
            moment += wp.outer(d, d)
    values, axes = eigen_symmetric(moment / wp.max(count - 1.0, 1.0))
    quats[i] = matrix_to_quat(axes)
    scales[i] = wp.vec3(
        wp.sqrt(wp.max(values[0], 0.0)), wp.sqrt(wp.max(values[1], 0.0)), wp.sqrt(wp.max(values[2], 0.0))
    )


def estimate_covariances(
    points: Any, queries: Any, neighbours: Any, *, quats: Any, scales: Any, device: Any
) -> None:
    """Fit a Gaussian to each query's neighbours.

    Args:
        points: [n] wp.vec3, metres.
        queries: [m] wp.vec3, metres.
        neighbours: [m, k] int into ``points``; -1 where there are fewer.
        quats: [m] wp.vec4, written: rotation of the ellipse, w first, w >= 0, unit length.
        scales: [m] wp.vec3, written: standard deviations, metres, falling.
    """
    launch_split(
        _estimate,
        queries.shape[0],
        inputs=[points, queries, neighbours],
        outputs=[quats, scales],
        device=device,
    )


@wp.func
def normalised_scale(s: wp.vec3) -> wp.vec3:
    """GG-SLAM eq. (1): standard deviations divided by their median."""
    low = wp.min(wp.min(s[0], s[1]), s[2])
    high = wp.max(wp.max(s[0], s[1]), s[2])
    median = s[0] + s[1] + s[2] - low - high
    if not (median > 0.0):
        return wp.vec3(1.0, 1.0, 1.0)
    return s / median


@wp.kernel
def _normalise(scales: wp.array[wp.vec3], out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = normalised_scale(scales[i])


def normalise_scales(scales: Any, *, out: Any, device: Any) -> None:
    """Divide each ellipse's standard deviations by their median, eq. (1); a point becomes a unit ball.

    Args:
        scales: [n] wp.vec3, metres.
        out: [n] wp.vec3, written.
    """
    wp.launch(_normalise, dim=scales.shape[0], inputs=[scales], outputs=[out], device=device)
