# SPDX-License-Identifier: Apache-2.0
"""The map's trackable points: what the tracker registers frames to.

They are kept apart from the Gaussians that mapping optimises: a point stays where its keyframe's depth
put it, so that appearance never moves the geometry that poses rest on. Where the keyframe is moved, its
points go with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float32, Float64, FramePoints, MapSnapshot

_NEIGHBOURS = 16
"""Neighbours among which an earlier keyframe's point is looked for: those of one frame lie closer than its
reach, but not so many."""


@dataclass(frozen=True)
class TrackableConfig:
    """How densely trackable points are laid."""

    distance: float = 0.025
    """A keyframe's point becomes trackable when the map is farther from it than this, metres, and than the
    sensor's noise there."""


@state_value
@dataclass(frozen=True)
class _KeyframePoints:
    """A keyframe's points as it brought them, and where they are in the world.

    Attributes:
        index: the keyframe's. T_wc: [4, 4] its pose.
        points, quats: [n, 3] and [n, 4], camera frame.
        spreads: [n, 3]. noise: [n], see :class:`ggwarp.types.FramePoints`.
        means, world_quats: [n, 3] and [n, 4], world frame.
    """

    index: int
    T_wc: Float64
    points: Float32
    quats: Float32
    spreads: Float32
    noise: Float32
    means: Float32
    world_quats: Float32

    @classmethod
    def placed(
        cls, index: int, T_wc: Float64, points: Float32, quats: Float32, spreads: Float32, noise: Float32
    ) -> _KeyframePoints:
        """Return the points of a keyframe at ``T_wc``."""
        means = se3.transform_points(T_wc, points).astype(np.float32)
        world_quats = se3.rotate_quats(T_wc[:3, :3], quats).astype(np.float32)
        return cls(index, T_wc, points, quats, spreads, noise, means, world_quats)

    def moved(self, motion: Float64) -> _KeyframePoints:
        T_wc = se3.orthonormalised(motion @ self.T_wc)
        return self.placed(self.index, T_wc, self.points, self.quats, self.spreads, self.noise)

    def kept(self, flags: NDArray[np.bool_]) -> _KeyframePoints:
        rows = (self.points, self.quats, self.spreads, self.noise, self.means, self.world_quats)
        return _KeyframePoints(self.index, self.T_wc, *(row[flags] for row in rows))


class TrackableMap(Stateful):
    """Trackable points; grows by keyframes, and changes where these are moved.

    Attributes:
        device: of the snapshots.
    """

    STATE = ("_keyframes", "_version")

    def __init__(self, config: TrackableConfig, *, device: Any = "cpu") -> None:
        self._config = config
        self.device = device
        self._keyframes: list[_KeyframePoints] = []
        self._snapshot: MapSnapshot | None = None
        self._version = 0

    @property
    def distance(self) -> float:
        """How densely points are laid, metres."""
        return self._config.distance

    def __len__(self) -> int:
        return sum(len(k.means) for k in self._keyframes)

    def add(self, points: FramePoints | None, T_wc: Float64, index: int = 0) -> int:
        """Add a keyframe's points that the map lacks; return how many.

        Args:
            T_wc: [4, 4] the keyframe's pose. index: its frame's, to move it by.

        Raises:
            ValueError: there are no points.
        """
        if points is None:
            raise ValueError("the tracker gives no points to track by: choose keyframes by covisibility")
        # A reading within its own noise of the map says nothing new. Far ones, kept all the same, fill space
        # with points: the nearest one is then close wherever the camera is, and motion is underestimated.
        new = points.distances2 > self._reach(points.noise) ** 2
        own = points.points[new], points.quats[new], points.spreads[new], points.noise[new]
        self._keyframes.append(_KeyframePoints.placed(index, T_wc, *own))
        self._changed()
        return int(new.sum())

    def move(self, correction: PoseCorrection) -> None:
        """Let the points follow their keyframes, and drop those that came to lie on an earlier one's."""
        motions = correction.at([k.index for k in self._keyframes])
        still = np.eye(4)
        self._keyframes = [
            k if (motion == still).all() else k.moved(motion)
            for k, motion in zip(self._keyframes, motions, strict=True)
        ]
        self._merge_layers()
        self._changed()

    def _merge_layers(self) -> None:
        """Drop points that an earlier keyframe's would have kept out, had they been where they are now."""
        if not len(self):
            return
        means = np.concatenate([k.means for k in self._keyframes])
        owners = np.repeat(np.arange(len(self._keyframes)), [len(k.means) for k in self._keyframes])
        reach = self._reach(np.concatenate([k.noise for k in self._keyframes]))
        distances, nearest = KDTree(means).query(means, k=min(_NEIGHBOURS, len(means)), workers=1)
        distances, nearest = distances.reshape(len(means), -1), nearest.reshape(len(means), -1)
        covered = (owners[nearest] < owners[:, None]) & (distances <= reach[:, None])
        kept = np.split(~covered.any(axis=1), np.flatnonzero(np.diff(owners)) + 1)
        holders = [k for k in self._keyframes if len(k.means)]
        self._keyframes = [k.kept(flags) for k, flags in zip(holders, kept, strict=True)]

    def _reach(self, noise: Float32) -> Float32:
        return np.maximum(self._config.distance, noise)

    def _changed(self) -> None:
        self._version += 1
        self._snapshot = None

    def snapshot(self) -> MapSnapshot:
        """Return the points as they are now; later changes do not reach it."""
        if self._snapshot is None:
            arrays = [
                wp.array(
                    np.concatenate(rows) if rows else np.zeros((0, width)), dtype=dtype, device=self.device
                )
                for rows, width, dtype in (
                    ([k.means for k in self._keyframes], 3, wp.vec3),
                    ([k.world_quats for k in self._keyframes], 4, wp.vec4),
                    ([k.spreads for k in self._keyframes], 3, wp.vec3),
                )
            ]
            self._snapshot = MapSnapshot(self._version, *arrays)
        return self._snapshot
