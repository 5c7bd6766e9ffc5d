# SPDX-License-Identifier: Apache-2.0
"""The trackable points of a finished run: its own where a checkpoint has them, else made of its Gaussians.

Gaussians begin where depth was read and hardly move: their centres are nearer to the surface than what
is rendered of them. Those that a view shows are averaged in voxels; the ellipses are those of neighbours.
Readings of depth, which a run's own points are, are nearer still.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.voxels import voxel_keys
from ggwarp.io.guarded import FileError
from ggwarp.kernels.registration import covariance
from ggwarp.map.gaussians import Gaussians
from ggwarp.pipeline.tracking.preprocess import NEIGHBOURS, ObservationConfig, plane_spreads
from ggwarp.results.checkpoints import FoundRun
from ggwarp.results.frame_table import read_frames
from ggwarp.results.saved_run import SavedRun
from ggwarp.runtime.state import StateError, unpack
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Frame, FramePoints

_TOLERANCE = 0.05
"""A view shows a Gaussian where their depths differ by no more than this share."""


def saved_points(run: SavedRun) -> FramePoints | None:
    """Return the trackable points of ``run``, in the world frame; None: no checkpoint of its end has any."""
    try:
        tree, _ = FoundRun(run.folder, run.folder).load()
        if tree["record"]["frames"] != len(read_frames(run.folder)):
            return None  # what came after it may have moved the map
        keyframes = unpack(tree["tracking"]["_trackable"]["_keyframes"], no_frames)
        names = ("means", "world_quats", "spreads", "noise")
        means, quats, spreads, noise = (np.concatenate([getattr(k, n) for k in keyframes]) for n in names)
    except (FileError, StateError, LookupError, TypeError, ValueError, AttributeError):
        return None
    return FramePoints(means, quats, spreads, noise, np.full(len(means), np.inf, np.float32))


def no_frames(index: int) -> Frame:
    """Refuse to read a frame, by :class:`StateError`: points have none."""
    raise StateError(f"frame {index} is not needed")


def surface_points(
    gaussians: Gaussians,
    views: Iterable[tuple[Float32, Float64]],
    camera: Camera,
    config: ObservationConfig,
    *,
    spacing: float,
    device: Any,
) -> FramePoints:
    """Return the points of a map's surface, in the world frame.

    Args:
        views: [h, w] depth that ``camera`` sees of the map, metres, 0 = none, and its pose [4, 4].
        config: the sensor's noise, which a Gaussian has as if taken by the nearest view that shows it.
        spacing: of the points, metres.
    """
    nearest = np.full(len(gaussians), np.inf)
    for depth, T_wc in views:
        x = se3.transform_points(se3.inverse(T_wc), gaussians.means)
        rows, columns, inside = camera.pixels_of(x)
        z, surface = x[inside, 2], depth[rows[inside], columns[inside]]
        shown = np.zeros(len(gaussians), bool)
        shown[inside] = (surface > 0.0) & (np.abs(surface - z) <= _TOLERANCE * z)
        nearest[shown] = np.minimum(nearest[shown], x[shown, 2])
    kept = np.isfinite(nearest) & (gaussians.opacity_logits > 0.0)
    points, z = _averaged(gaussians.means[kept].astype(np.float64), nearest[kept], spacing)
    count = len(points)
    noise = config.depth_noise(z)
    row: Any = wp.vec3
    four: Any = wp.vec4
    quats = wp.empty(count, dtype=four, device=device)
    scales, spreads = (wp.empty(count, dtype=row, device=device) for _ in range(2))
    if count:
        _, neighbours = KDTree(points).query(points, k=min(NEIGHBOURS, count), workers=1)
        on_device: Any = wp.array(points, dtype=wp.vec3, device=device)
        rows = wp.array(neighbours.reshape(count, -1).astype(np.int32), dtype=int, device=device)
        covariance.estimate_covariances(on_device, on_device, rows, quats=quats, scales=scales, device=device)
        share = float(np.median(to_host(scales)[:, 2] / noise))
        spreads = plane_spreads(scales, wp.array(noise, dtype=float, device=device), share, device)
    unmatched = np.full(count, np.inf, np.float32)
    return FramePoints(points.astype(np.float32), to_host(quats), to_host(spreads), noise, unmatched)


def _averaged(points: Float64, z: Float64, size: float) -> tuple[Float64, Float32]:
    """Return the means of ``points`` [n, 3] and of ``z`` [n] in each voxel of ``size`` metres."""
    _, voxel, counts = np.unique(voxel_keys(points, size), return_inverse=True, return_counts=True)
    columns = [np.bincount(voxel, values, minlength=len(counts)) / counts for values in (*points.T, z)]
    return np.stack(columns[:3], axis=1), columns[3].astype(np.float32)
