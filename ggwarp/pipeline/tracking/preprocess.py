# SPDX-License-Identifier: Apache-2.0
"""From a depth image to the points that a frame is tracked with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.registration import covariance, pixel_neighbours
from ggwarp.runtime.scratch import ScratchArrays
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.registration import Cloud
from ggwarp.types import Float32, Float64

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
        points: [n, 3] float32, those points on the host, metres.
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
    points: Float32
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
    on_host, uv = sample_points(image, camera, stride, near=_NEAR, far=config.far)
    n, z = len(on_host), np.ascontiguousarray(on_host[:, 2])
    spacing = _median(z) * stride / camera.fx if n else 0.0
    noise = config.depth_noise(z)
    if weights is not None:
        noise /= np.sqrt(np.maximum(weights[uv[:, 1], uv[:, 0]], _MIN_WEIGHT))
    arrays = ScratchArrays(device) if scratch is None else scratch
    points, pixels = arrays.upload("points", on_host, wp.vec3), arrays.upload("pixels", uv, wp.vec2i)
    deviations = arrays.upload("noise", noise, wp.float32)
    grid = pixel_neighbours.sample_grid(h, w, stride)
    places = arrays.take("places", grid, wp.int32)
    quats, scales = fit_ellipses(
        points, pixels, camera, stride=stride, k=NEIGHBOURS, places=places, device=device, scratch=arrays
    )
    tilts = arrays.take("tilts", n, wp.float64)
    pixel_neighbours.normal_tilts(
        points,
        pixels,
        places,
        stride=stride,
        apart=_APART,
        same_surface=_SAME_SURFACE,
        quats=quats,
        scales=scales,
        deviations=deviations,
        neighbours=NEIGHBOURS,
        tilts=tilts,
        device=device,
    )
    noise_share = measured_noise(to_host(tilts))
    spreads = plane_spreads(scales, deviations, noise_share, device, scratch=arrays)
    covariances = arrays.take("covariances", n, wp.mat33)
    covariance.build_covariances(quats, spreads, covariances=covariances, device=device)
    cloud = Cloud(points, covariances)
    return Observation(cloud, on_host, quats, scales, pixels, stride, spacing, spreads, noise, noise_share)


def sample_points(
    image: Float32, camera: Camera, stride: int, *, near: float, far: float
) -> tuple[Float32, NDArray[np.int32]]:
    """Return the points [n, 3] of every ``stride``-th row and column of ``image``, and their pixels [n, 2].

    Args:
        image: [h, w] metres; 0, NaN and inf are no reading.
        stride: pixels between samples; the first lies at stride // 2.
        near, far: readings outside are dropped, metres.

    Returns:
        Camera frame, metres, and (u, v), by rows.
    """
    z = image[stride // 2 :: stride, stride // 2 :: stride]
    kept = (z >= near) & (z <= far)
    row, column = np.nonzero(kept)
    z = z[kept]
    points, pixels = np.empty((len(z), 3), np.float32), np.empty((len(z), 2), np.int32)
    for axis, sample, centre, focal in ((0, column, camera.cx, camera.fx), (1, row, camera.cy, camera.fy)):
        pixel = sample * stride + stride // 2
        pixels[:, axis] = pixel
        points[:, axis] = (pixel.astype(np.float32) - np.float32(centre)) * z / np.float32(focal)
    points[:, 2] = z
    return points, pixels


def fit_ellipses(
    points: Any,
    pixels: Any,
    camera: Camera,
    *,
    stride: int,
    k: int,
    places: Any,
    device: Any,
    scratch: ScratchArrays | None = None,
) -> tuple[Any, Any]:
    """Return the quaternions [n] and scales [n] of ellipses fitted to each point's ``k`` nearest.

    Args:
        points, pixels, stride: as in :class:`Observation`.
        k: neighbours, itself among them; 16 at most.
        places: written where there are points, see
            :func:`ggwarp.kernels.registration.pixel_neighbours.find_k_nearest_pixels`.
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
            places=places,
            indices=indices,
            device=device,
        )
        covariance.estimate_covariances(points, points, indices, quats=quats, scales=scales, device=device)
    return quats, scales


def plane_spreads(
    scales: Any, noise: Any, noise_share: float, device: Any, *, scratch: ScratchArrays | None = None
) -> Any:
    """Return what matches trust points by, [n] wp.vec3: along and across the surface, metres.

    Args:
        scales: [n] wp.vec3, of the ellipses fitted to neighbourhoods, metres, falling.
        noise: [n] wp.float32, metres, and noise_share: see :class:`Observation`.
        scratch: as of :func:`observe`.
    """
    arrays = ScratchArrays(device) if scratch is None else scratch
    spreads = arrays.take("spreads", scales.shape[0], wp.vec3)
    covariance.plane_scales(
        scales,
        noise=noise,
        noise_share=noise_share,
        neighbours=NEIGHBOURS,
        slip=_SLIP,
        scales=spreads,
        device=device,
    )
    return spreads


def measured_noise(tilts: Float64) -> float:
    """Return how noisy a frame is, as a share of what its sensor's model says; 0 where too little is seen.

    The normals of one surface differ by their errors. That is measured where noise matters, and has the
    errors in it that neighbouring readings share, as a sensor's interpolation makes them; the median does
    not see edges. 0.0-0.2 for rendered depth, 0.8-1.2 for a Kinect's, 1.3-1.5 for stereo.

    Args:
        tilts: [n] see :func:`ggwarp.kernels.registration.pixel_neighbours.normal_tilts`.
    """
    tilts = tilts[tilts >= 0.0]
    # The angle between two normals is of Rayleigh's distribution: its median is 1.177 sqrt(2) deviations.
    return 0.0 if len(tilts) < _MIN_PAIRS else _median(tilts) / (1.177 * math.sqrt(2.0))


def _median(values: NDArray[Any]) -> float:
    """Return the median of ``values`` [n], of which there is one; a fifth of the time of NumPy's."""
    middle = (len(values) - 1) // 2, len(values) // 2
    low, high = np.partition(values, middle)[list(middle)]
    return float((low + high) / 2)
