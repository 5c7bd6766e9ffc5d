# SPDX-License-Identifier: Apache-2.0
"""The map's trackable points: what the tracker registers frames to.

They are kept apart from the Gaussians that mapping optimises: a point stays where its keyframe's depth
put it, so that appearance never moves the geometry that poses rest on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64, FramePoints, MapSnapshot


@dataclass(frozen=True)
class TrackableConfig:
    """How densely trackable points are laid."""

    distance: float = 0.025
    """A keyframe's point becomes trackable when the map is farther from it than this, metres, and than the
    sensor's noise there."""


class TrackableMap(Stateful):
    """Trackable points, world frame; grows by keyframes, never changes otherwise."""

    STATE = ("_means", "_quats", "_spreads", "_version")

    def __init__(self, config: TrackableConfig, *, device: Any = "cpu") -> None:
        self._config = config
        self._device = device
        self._means: list[Float32] = []
        self._quats: list[Float32] = []
        self._spreads: list[Float32] = []
        self._snapshot: MapSnapshot | None = None
        self._version = 0

    def __len__(self) -> int:
        return sum(map(len, self._means))

    def add(self, points: FramePoints | None, T_wc: Float64) -> int:
        """Add a keyframe's points that the map lacks; return how many.

        Args:
            T_wc: [4, 4] the keyframe's pose.

        Raises:
            ValueError: there are no points.
        """
        if points is None:
            raise ValueError("the tracker gives no points to track by: choose keyframes by covisibility")
        # A reading within its own noise of the map says nothing new. Far ones, kept all the same, fill space
        # with points: the nearest one is then close wherever the camera is, and motion is underestimated.
        new = points.distances2 > np.maximum(self._config.distance, points.noise) ** 2
        self._means.append(se3.transform_points(T_wc, points.points[new]).astype(np.float32))
        self._quats.append(se3.rotate_quats(T_wc[:3, :3], points.quats[new]).astype(np.float32))
        self._spreads.append(points.spreads[new])
        self._version += 1
        self._snapshot = None
        return int(new.sum())

    def snapshot(self) -> MapSnapshot:
        """Return the points as they are now; later changes do not reach it."""
        if self._snapshot is None:
            arrays = [
                wp.array(
                    np.concatenate(rows) if rows else np.zeros((0, width)), dtype=dtype, device=self._device
                )
                for rows, width, dtype in (
                    (self._means, 3, wp.vec3),
                    (self._quats, 4, wp.vec4),
                    (self._spreads, 3, wp.vec3),
                )
            ]
            self._snapshot = MapSnapshot(self._version, *arrays)
        return self._snapshot
