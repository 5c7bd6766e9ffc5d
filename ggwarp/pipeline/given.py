# SPDX-License-Identifier: Apache-2.0
"""Poses taken from the data set, in a tracker's place: what mapping gives when tracking is perfect."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggwarp.ops.registration import Target, build_target, match_distances2
from ggwarp.pipeline.observation import observe
from ggwarp.pipeline.tracker import TrackerConfig
from ggwarp.types import Camera, Float64, Frame, MapSnapshot, TrackResult, Verdict


class GivenPoses:
    """Reports every frame's true pose, with the overlap that keyframes are chosen by."""

    def __init__(self, config: TrackerConfig, sensor_camera: Camera, *, device: Any = "cpu") -> None:
        """Take the place of a :class:`ggwarp.pipeline.tracker.GicpTracker`."""
        self._config = config
        self._camera = sensor_camera
        self._device = device
        self._target: Target | None = None
        self._target_version: int | None = None
        self._T_last = np.eye(4)

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame; all its points are new to the map."""
        return self._result(frame, np.array(T_wc, np.float64), None)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the frame's true pose; lost where there is none."""
        if frame.T_wc is None:
            return TrackResult(self._T_last, Verdict.LOST, "no true pose is known")
        if target.version != self._target_version:
            # Poses are not searched for here: cells as large as the one radius that is asked for.
            self._target = build_target(
                target.means,
                target.quats,
                target.scales,
                cell_size=2.0 * self._config.overlap_distance,
                device=self._device,
            )
            self._target_version = target.version
        return self._result(frame, frame.T_wc, self._target)

    def _result(self, frame: Frame, T_wc: Float64, target: Target | None) -> TrackResult:
        self._T_last = T_wc
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        if image is None:
            raise ValueError(f"frame {frame.index} has no depth: mapping needs it")
        seen = observe(image, self._camera, self._config.observation, device=self._device)
        distances2 = np.full(seen.count, np.inf, np.float32)
        if target is not None:
            radius = max(self._config.overlap_distance, self._config.reach * seen.spacing)
            distances2 = match_distances2(seen.cloud, target, T_wc, radius=radius, device=self._device)
        matched = distances2[np.isfinite(distances2)]
        return TrackResult(
            T_wc=T_wc,
            verdict=Verdict.CONVERGED,
            overlap=len(matched) / max(seen.count, 1),
            rmse=float(np.sqrt(matched.mean(dtype=np.float64))) if len(matched) else 0.0,
            points=seen.cloud.points.numpy(),
            quats=seen.quats.numpy(),
            scales=seen.scales.numpy(),
            spreads=seen.spreads.numpy(),
            distances2=distances2,
            pixels=seen.pixels.numpy(),
        )
