# SPDX-License-Identifier: Apache-2.0
"""A frame about to be registered to a map, for us and for small_gicp: the same points on both sides."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ggwarp.datasets import Dataset, DatasetError, SyntheticOffice, open_dataset
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.registration import covariance, hash_grid
from ggwarp.kernels.registration.pixel_neighbours import sample_grid
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.keyframe_policy import KeyframeConfig, KeyframeKind, OverlapKeyframes
from ggwarp.pipeline.tracking.point_map import TrackableConfig, TrackableMap
from ggwarp.pipeline.tracking.preprocess import Observation, fit_ellipses, observe
from ggwarp.solvers.registration import Cloud, Registration, RegistrationStage, RegistrationTarget, register
from ggwarp.types import Float64, Frame, MapSnapshot

NEIGHBOURS = 10
RADIUS, TOLERANCE, MOST_ITERATIONS = 0.1, 1e-5, 64
"""Farthest match, metres; smallest step, metres and radians; linearisations at most: for both."""


@dataclass(frozen=True)
class Situation:
    """Tracking at one moment.

    Attributes:
        camera: of the depth images.
        previous, T_previous: the last frame and its pose.
        frame: the one to register.
        target: the map at that time.
        seen: ``frame``'s points.
    """

    camera: Camera
    previous: Frame
    T_previous: Float64
    frame: Frame
    target: MapSnapshot
    seen: Observation

    @property
    def points(self) -> Float64:
        return np.asarray(self.seen.cloud.points.numpy(), np.float64)


def small_gicp_or_none() -> Any:
    """Return the module small_gicp, or None where it is not installed."""
    try:
        return importlib.import_module("small_gicp")
    except ImportError:
        return None


def tracking_sequence(seq: str | None, data: Path) -> Dataset:
    """Open ``seq``; None: redkitchen under ``data``, or the built-in office at 640 pixels across.

    Raises:
        DatasetError: ``seq`` is not there, or has no depth.
    """
    if seq is None:
        try:
            return open_dataset("redkitchen", data_root=data, masks="none")
        except DatasetError:
            return SyntheticOffice(scale=640 / 1200)
    dataset = open_dataset(seq, data_root=data, masks="none")
    if not dataset.has_depth:
        raise DatasetError(f"{seq}: no depth images, which registration needs")
    return dataset


def situation(dataset: Dataset, frames: int, *, device: Any) -> Situation:
    """Track the first frames of ``dataset``; return how things stand before the last of them.

    Args:
        frames: at least 2.
    """
    config = GicpConfig()
    tracker = GicpTracker(config, dataset.camera, device=device)
    trackable = TrackableMap(TrackableConfig(), device=device)
    policy = OverlapKeyframes(KeyframeConfig())
    previous = dataset[0]
    result = tracker.start(previous, np.eye(4) if previous.T_wc is None else previous.T_wc)
    for index in range(1, min(frames, len(dataset))):
        if policy.decide(result) is KeyframeKind.TRACKING:
            trackable.add(result.points, result.T_wc)
        frame = dataset[index]
        if index == min(frames, len(dataset)) - 1:
            break
        previous, result = frame, tracker.track(frame, trackable.snapshot())
    else:
        raise DatasetError(f"{dataset.name}: {len(dataset)} frames; at least 2 are needed")
    image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
    assert image is not None
    seen = observe(image, dataset.camera, config, device=device)
    return Situation(dataset.camera, previous, result.T_wc, frame, trackable.snapshot(), seen)


def grown(target: MapSnapshot, times: int, *, device: Any) -> MapSnapshot:
    """Return ``target`` with its copies beside it: ``times`` as many points, as dense as before."""
    means, quats, scales = (a.numpy() for a in (target.means, target.quats, target.scales))
    width = float(np.ptp(means[:, 0])) + 1.0
    shifted = [means + np.array([k * width, 0.0, 0.0], np.float32) for k in range(times)]
    rows = ((shifted, wp.vec3), ([quats] * times, wp.vec4), ([scales] * times, wp.vec3))
    arrays = [wp.array(np.concatenate(parts), dtype=dtype, device=device) for parts, dtype in rows]
    return MapSnapshot(1000 * target.version + times, *arrays)


class Ours:
    """Our registration of a situation, with ellipses that may be given."""

    def __init__(self, at: Situation, device: Any, covariances: tuple[Any, Any] | None = None) -> None:
        """Args: covariances: [n, 3, 3] of the frame's and the map's points, m^2; None: our own."""
        self._at, self._device = at, device
        self._cell_size = 2.5 * at.seen.spacing
        self._cloud, self._target = at.seen.cloud, self.index_map(at.target)
        if covariances is not None:
            order = self._target.grid.indices.numpy()[: at.target.count]
            own, map_s = covariances
            mat33: Any = wp.mat33
            self._cloud = Cloud(at.seen.cloud.points, wp.array(own, dtype=mat33, device=device))
            self._target = RegistrationTarget(
                self._target.grid, wp.array(map_s[order], dtype=mat33, device=device)
            )

    def fit_ellipses(self) -> Any:
        """Return the covariance of each of the frame's points, from its 10 nearest."""
        seen, camera, device = self._at.seen, self._at.camera, self._device
        quats, scales = fit_ellipses(
            seen.cloud.points,
            seen.pixels,
            camera,
            stride=seen.stride,
            k=NEIGHBOURS,
            places=wp.empty(sample_grid(camera.height, camera.width, seen.stride), dtype=int, device=device),
            device=device,
        )
        mat33: Any = wp.mat33
        out = wp.empty(seen.count, dtype=mat33, device=device)
        covariance.build_covariances(quats, scales, covariances=out, device=device)
        return out

    def index_map(self, target: MapSnapshot) -> RegistrationTarget:
        """Return the map, ready for searches."""
        grid = hash_grid.allocate_hash_grid(target.count, device=self._device)
        hash_grid.build_hash_grid(grid, target.means, cell_size=self._cell_size, device=self._device)
        mat33: Any = wp.mat33
        covariances = wp.empty(target.count, dtype=mat33, device=self._device)
        covariance.build_covariances(
            target.quats, target.scales, order=grid.indices, covariances=covariances, device=self._device
        )
        return RegistrationTarget(grid, covariances)

    def register(self) -> Registration:
        """Register the frame from the previous pose: one radius, least squares."""
        stages = [RegistrationStage(RADIUS, MOST_ITERATIONS, TOLERANCE)]
        return register(self._cloud, self._target, self._at.T_previous, stages, device=self._device)


class Peer:
    """small_gicp's registration of the same points."""

    def __init__(self, at: Situation, small_gicp: Any, threads: int) -> None:
        self._at, self._module, self._threads = at, small_gicp, threads
        self._frame_cloud = small_gicp.PointCloud(at.points)
        self._map_cloud = small_gicp.PointCloud(np.asarray(at.target.means.numpy(), np.float64))
        self.fit_ellipses()
        self._tree = self.index_map()
        small_gicp.estimate_covariances(self._map_cloud, self._tree, NEIGHBOURS, threads)

    @property
    def covariances(self) -> tuple[Any, Any]:
        """[n, 3, 3] float32 of the frame's and of the map's points."""
        clouds = (self._frame_cloud, self._map_cloud)
        own, map_s = (np.array(c.covs(), np.float32)[:, :3, :3] for c in clouds)
        return own, map_s

    def fit_ellipses(self) -> None:
        tree = self._module.KdTree(self._frame_cloud, num_threads=self._threads)
        self._module.estimate_covariances(self._frame_cloud, tree, NEIGHBOURS, self._threads)

    def index_map(self) -> Any:
        return self._module.KdTree(self._map_cloud, num_threads=self._threads)

    def register(self) -> Any:
        return self._module.align(
            self._map_cloud,
            self._frame_cloud,
            self._tree,
            self._at.T_previous,
            max_correspondence_distance=RADIUS,
            num_threads=self._threads,
            max_iterations=MOST_ITERATIONS,
            rotation_epsilon=TOLERANCE,
            translation_epsilon=TOLERANCE,
        )
