# SPDX-License-Identifier: Apache-2.0
"""From a depth image to the points that a frame is tracked with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.registration import back_projection, covariance, pixel_neighbours
from ggwarp.runtime.scratch import ScratchArrays
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.registration import Cloud
from ggwarp.types import Float32

_SLIP = 1.0
"""Largest standard deviation along a surface, metres: how freely matched patches slide along each other."""

_NEAR = 0.1
"""Readings closer are dropped, metres."""

NEIGHBOURS = 10
"""Neighbours that a point's ellipse is fitted to; 16 at most."""

_APART = 4
"""Samples between two normals that are compared: their neighbourhoods share no reading."""

_MIN_WEIGHT = 1e-3
"""Of a reading: what is less sure is as free as ever."""

_SAME_SURFACE = 0.05
"""Readings farther apart than this share of their depth are on two surfaces."""

_MIN_PAIRS = 100
"""Of fewer pairs of normals nothing is concluded."""


@dataclass(frozen=True)
class ObservationConfig:
    """Which readings of a depth image are used, and how far each is trusted."""

    points: int = 8000
    """About so many points of a frame are tracked: the sampling grid is as fine as that takes."""
    far: float = 12.0
    """Readings farther are dropped, metres; far ones count little anyway."""
    noise_floor: float = 0.001
    """Standard deviation of depth at no distance, metres."""
    noise_growth: float = 0.002
    """Growth of depth's standard deviation with squared distance, 1/metre: structured light and stereo."""

    def depth_noise(self, z: Float32) -> Float32:
        """Return the standard deviation of readings ``z`` (any shape), metres."""
        return np.float32(self.noise_floor) + np.float32(self.noise_growth) * z * z


@dataclass(frozen=True)
class Observation:
    """A frame's points, on the device, camera frame.

    Attributes:
        cloud: points and registration covariances.
        quats: [n] wp.vec4, axes of each point's ellipse, w first; the last axis is the normal.
        scales: [n] wp.vec3, metres, standard deviations of the neighbourhood, falling.
        pixels: [n] wp.vec2i, (u, v).
        stride: pixels between samples.
        spacing: median distance between neighbouring points, metres.
        spreads: [n] wp.vec3, metres, along and across the surface: the cloud's covariances.
        noise: [n] float32 on the host, metres, the sensor's standard deviation at each point, larger where a
            reading counts for less.
        noise_share: what the frame shows of it, see :func:`measured_noise`.
    """

    cloud: Cloud
    quats: Any
    scales: Any
    pixels: Any
    stride: int
    spacing: float
    spreads: Any
    noise: Float32
    noise_share: float

    @property
    def count(self) -> int:
        return self.cloud.count


def observe(
    image: Float32,
    camera: Camera,
    config: ObservationConfig,
    *,
    weights: Float32 | None = None,
    device: Any,
    scratch: ScratchArrays | None = None,
) -> Observation:
    """Sample ``image`` [h, w] (metres, 0 = no reading) and fit an ellipse to each point.

    Args:
        weights: [h, w] how much each reading counts, to 1, its variance being the inverse; None: all alike.
        scratch: lends all arrays, so that the result holds until it is used again; None: they are new.

    Raises:
        ValueError: an image that is not of the camera's size.
    """
    h, w = image.shape
    if (h, w) != (camera.height, camera.width):
        raise ValueError(f"depth image: {w}x{h}, but its camera takes {camera.width}x{camera.height}")
    readings = int(np.count_nonzero(image > 0.0))
    stride = max(1, round((readings / config.points) ** 0.5))
    rows, columns = back_projection.sample_grid(h, w, stride)
    room = rows * columns
    arrays = ScratchArrays(device) if scratch is None else scratch
    flags, slots = (arrays.take(name, max(room, 1), wp.int32) for name in ("flags", "slots"))
    flags.zero_()
    slots.zero_()
    points, pixels = arrays.take("points", room, wp.vec3), arrays.take("pixels", room, wp.vec2i)
    back_projection.sample_depth(
        arrays.upload("image", np.ascontiguousarray(image, np.float32), wp.float32),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        stride=stride,
        near=_NEAR,
        far=config.far,
        edge=0.0,  # readings at edges of depth are kept
        flags=flags,
        slots=slots,
        points=points,
        pixels=pixels,
        device=device,
    )
    n = int(to_host(flags[-1:])[0] + to_host(slots[-1:])[0])
    points, pixels = points[:n], pixels[:n]
    z = to_host(points)[:, 2]
    spacing = float(np.median(z)) * stride / camera.fx if n else 0.0
    quats, scales = fit_ellipses(
        points, pixels, camera, stride=stride, k=NEIGHBOURS, device=device, scratch=arrays
    )
    noise = config.depth_noise(z)
    if weights is not None:
        u, v = to_host(pixels).T
        noise /= np.sqrt(np.maximum(weights[v, u], _MIN_WEIGHT))
    noise_share = measured_noise(
        to_host(points), to_host(quats), to_host(scales), to_host(pixels), stride, noise
    )
    spreads = plane_spreads(scales, noise, noise_share, device, scratch=arrays)
    covariances = arrays.take("covariances", n, wp.mat33)
    covariance.build_covariances(quats, spreads, covariances=covariances, device=device)
    cloud = Cloud(points, covariances)
    return Observation(cloud, quats, scales, pixels, stride, spacing, spreads, noise, noise_share)


def fit_ellipses(
    points: Any,
    pixels: Any,
    camera: Camera,
    *,
    stride: int,
    k: int,
    device: Any,
    scratch: ScratchArrays | None = None,
) -> tuple[Any, Any]:
    """Return the quaternions [n] and scales [n] of ellipses fitted to each point's ``k`` nearest.

    Args:
        points, pixels, stride: as in :class:`Observation`.
        k: neighbours, itself among them; 16 at most.
        scratch: as of :func:`observe`.
    """
    n = points.shape[0]
    arrays = ScratchArrays(device) if scratch is None else scratch
    quats, scales = arrays.take("quats", n, wp.vec4), arrays.take("scales", n, wp.vec3)
    if n:
        indices = arrays.take("indices", (n, k), wp.int32)
        pixel_neighbours.find_k_nearest_pixels(
            points,
            pixels,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            stride=stride,
            k=k,
            places=arrays.take(
                "places", back_projection.sample_grid(camera.height, camera.width, stride), wp.int32
            ),
            indices=indices,
            device=device,
        )
        covariance.estimate_covariances(points, points, indices, quats=quats, scales=scales, device=device)
    return quats, scales


def plane_spreads(
    scales: Any, noise: Float32, noise_share: float, device: Any, *, scratch: ScratchArrays | None = None
) -> Any:
    """Return what matches trust points by, [n] wp.vec3: along and across the surface, metres.

    Args:
        scales: [n] wp.vec3, of the ellipses fitted to neighbourhoods, metres, falling.
        noise, noise_share: see :class:`Observation`.
        scratch: as of :func:`observe`.
    """
    arrays = ScratchArrays(device) if scratch is None else scratch
    spreads = arrays.take("spreads", scales.shape[0], wp.vec3)
    covariance.plane_scales(
        scales,
        noise=arrays.upload("noise", noise, wp.float32),
        noise_share=noise_share,
        neighbours=NEIGHBOURS,
        slip=_SLIP,
        scales=spreads,
        device=device,
    )
    return spreads


def measured_noise(
    points: Float32, quats: Float32, scales: Float32, pixels: Any, stride: int, noise: Float32
) -> float:
    """Return how noisy a frame is, as a share of ``noise``; 0 where too little is seen.

    The normals of one surface differ by their errors: a plane fitted to k readings of deviation s, spread
    over e, is tilted by s / (sqrt(k) e) about either axis. That is measured where noise matters, and has the
    errors in it that neighbouring readings share, as a sensor's interpolation makes them; the median does
    not see edges. 0.0-0.2 for rendered depth, 0.8-1.2 for a Kinect's, 1.3-1.5 for stereo.

    Args:
        points: [n, 3] camera frame, metres. quats: [n, 4] and scales: [n, 3], the ellipses fitted there.
        pixels: [n, 2] (u, v), on a grid of ``stride``.
        noise: [n] metres.
    """
    column, row = (pixels // stride).T
    place = np.full((row.max(initial=0) + 1, column.max(initial=0) + 1), -1)
    place[row, column] = np.arange(len(points))
    a, b = place[:, :-_APART].ravel(), place[:, _APART:].ravel()
    z = points[:, 2]
    a, b = (side[(a >= 0) & (b >= 0)] for side in (a, b))
    a, b = (side[np.abs(z[a] - z[b]) < _SAME_SURFACE * z[a]] for side in (a, b))
    if len(a) < _MIN_PAIRS:
        return 0.0
    normals = se3.matrices_from_quats(quats)[:, :, 2]
    angles = np.arccos(np.clip(np.abs((normals[a] * normals[b]).sum(axis=1)), 0.0, 1.0))
    extents = np.maximum(np.sqrt(scales[a, 0] * scales[a, 1]), 1e-6)
    expected = noise[a] / (np.sqrt(NEIGHBOURS) * extents)
    # The angle between two normals is of Rayleigh's distribution: its median is 1.177 sqrt(2) deviations.
    return float(np.median(angles / expected) / (1.177 * np.sqrt(2.0)))
