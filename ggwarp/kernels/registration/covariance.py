# SPDX-License-Identifier: Apache-2.0
"""A Gaussian for each point from its nearest neighbours: rotation and scale (GG-SLAM section 1a)."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.math import covariance_of, eigen_symmetric, matrix_to_quat
from ggwarp.runtime.launch import launch_split

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


@wp.kernel
def _plane_scales(
    spreads: wp.array[wp.vec3],
    deviations: wp.array[wp.float32],
    noise_share: float,
    neighbours: int,
    slip: float,
    scales: wp.array[wp.vec3],
):
    i = wp.tid()
    noise = deviations[i]
    extent = spreads[i]
    across = wp.sqrt(noise * noise + extent[2] * extent[2])
    # A plane through k readings of deviation s, spread over e, is tilted by s / (sqrt(k) e).
    free = wp.sqrt(float(neighbours)) * across / wp.max(noise_share * noise, 1.0e-9)
    scales[i] = wp.vec3(
        wp.max(across, wp.min(slip, free * extent[0])), wp.max(across, wp.min(slip, free * extent[1])), across
    )


def plane_scales(
    spreads: Any,
    *,
    noise: Any,
    noise_share: float,
    neighbours: int,
    slip: float,
    scales: Any,
    device: Any,
) -> None:
    """Say how surely each point fixes the pose: across its surface, and along it.

    Across: the sensor's noise and the thickness of the neighbourhood, which is more than noise where
    the surface bends or two surfaces meet, and the normal means little.

    Along: as far as the surface can be moved along itself before the error of its normal moves it across by
    a deviation. Two surfaces that were freer could not be told from ones at an angle, and of noisy points
    only those would count whose normals happen to agree.

    Args:
        spreads: [n] wp.vec3, the neighbourhood's standard deviations, falling, metres.
        noise: [n] float32, standard deviation of each point's depth, metres.
        noise_share: how much of it there is: that tilts the normals.
        neighbours: readings in a neighbourhood.
        slip: largest standard deviation along the surface, metres.
        scales: [n] wp.vec3, written: (along, along, across), as :func:`estimate_covariances` orders its axes.
    """
    wp.launch(
        _plane_scales,
        dim=spreads.shape[0],
        inputs=[spreads, noise, noise_share, neighbours, slip],
        outputs=[scales],
        device=device,
    )


@wp.kernel
def _covariances(
    offset: int,
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    order: wp.array[int],
    covariances: wp.array[wp.mat33],
):
    i = offset + wp.tid()
    j = i
    if order.shape[0] > 0:
        j = order[i]
    covariances[i] = covariance_of(wp.normalize(quats[j]), scales[j])


def build_covariances(quats: Any, scales: Any, *, order: Any = None, covariances: Any, device: Any) -> None:
    """Multiply ellipses out: R diag(s^2) R^T.

    Args:
        quats: [n] wp.vec4, w first, any length but 0.
        scales: [n] wp.vec3, standard deviations.
        order: [>= n] int: row i of the result is ellipse ``order[i]``; None: i.
        covariances: [n] wp.mat33, written.
    """
    launch_split(
        _covariances,
        quats.shape[0],
        # A null array has no elements.
        inputs=[quats, scales, order],
        outputs=[covariances],
        device=device,
        min_piece=4096,
    )
