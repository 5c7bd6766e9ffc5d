# SPDX-License-Identifier: Apache-2.0
"""The SLAM system: track a frame, decide what it adds, add it, refine the map."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ggwarp.io.ply import PlyGaussians
from ggwarp.pipeline.given_poses import GivenPoses
from ggwarp.pipeline.keyframes import KeyframeConfig, KeyframeKind, OverlapKeyframes
from ggwarp.pipeline.mapper import Mapper, MapperConfig
from ggwarp.pipeline.scheduler import Scheduler, SynchronousScheduler
from ggwarp.pipeline.trackable import TrackableConfig, TrackableMap
from ggwarp.pipeline.tracker import GicpTracker, TrackerConfig
from ggwarp.types import Camera, Float64, Frame, Rendered, StepReport, TrackResult, Verdict


@dataclass(frozen=True)
class SlamConfig:
    """The whole system: its parts' configurations and what joins them."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    trackable: TrackableConfig = field(default_factory=TrackableConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    use_identity: bool = True
    """Learn which object each Gaussian belongs to (GG-SLAM); False is GS-ICP-SLAM."""
    use_true_poses: bool = False
    """Take poses from the data set instead of tracking (mapping only, for comparison)."""


class Slam:
    """Object-level RGB-D SLAM, one frame at a time.

    Attributes:
        map: the Gaussians.
        reports: one row a frame.
        keyframe_indices: frames that were ever used for mapping.
        counts: tracking_keyframes, mapping_keyframes, frames_lost.
    """

    def __init__(
        self,
        config: SlamConfig,
        camera: Camera,
        sensor_camera: Camera,
        *,
        device: Any = "cpu",
        scheduler: Scheduler | None = None,
    ) -> None:
        """Build an empty map and the parts that work on it.

        Args:
            camera: of the frames' ``rgb``, ``depth`` and ``mask``.
            sensor_camera: of the frames' ``sensor_depth``.
            scheduler: how much mapping a frame gets; default: ``config.mapper.iterations`` each.
        """
        self.config = config
        tracker = GivenPoses if config.use_true_poses else GicpTracker
        self._tracker = tracker(config.tracker, sensor_camera, device=device)
        self._trackable = TrackableMap(config.trackable, device=device)
        self._policy = OverlapKeyframes(config.keyframes)
        self._mapper = Mapper(config.mapper, camera, device=device, use_identity=config.use_identity)
        self._scheduler = scheduler or SynchronousScheduler(config.mapper.iterations)
        self.map = self._mapper.map
        self.reports: list[StepReport] = []
        self.counts = {"tracking_keyframes": 0, "mapping_keyframes": 0, "frames_lost": 0}

    def step(self, frame: Frame) -> StepReport:
        """Process the next frame: pose first, then the map."""
        late = self._scheduler.begin_frame()
        started = time.perf_counter()
        result = self._track(frame)
        tracked = time.perf_counter()
        kind = self._policy.decide(result)
        if kind is not KeyframeKind.NONE:
            self._mapper.insert(frame, result.T_wc)
        if kind is KeyframeKind.TRACKING:
            self._trackable.add(result)
        losses = self._refine()
        return self._report(frame, result, kind, losses, (late, started, tracked, time.perf_counter()))

    def render(self, T_wc: Float64) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4] at the run's image size."""
        return self._mapper.render(T_wc)

    @property
    def keyframe_indices(self) -> list[int]:
        return self._mapper.keyframe_indices

    def map_arrays(self) -> PlyGaussians:
        """Return the map on the host, with object ids."""
        return self._mapper.export()

    def _track(self, frame: Frame) -> TrackResult:
        if self._policy.empty:
            return self._tracker.start(frame, np.eye(4) if frame.T_wc is None else frame.T_wc)
        return self._tracker.track(frame, self._trackable.snapshot())

    def _refine(self) -> list[float]:
        losses: list[float] = []
        while self._mapper.ready and self._scheduler.wants_more(len(losses)):
            losses.append(self._mapper.iterate())
        return losses

    def _report(
        self,
        frame: Frame,
        result: TrackResult,
        kind: KeyframeKind,
        losses: list[float],
        times: tuple[float, float, float, float],
    ) -> StepReport:
        self.counts["frames_lost"] += result.verdict is Verdict.LOST
        if kind is not KeyframeKind.NONE:
            self.counts[f"{kind.value}_keyframes"] += 1
        late, started, tracked, mapped = times
        report = StepReport(
            index=frame.index,
            timestamp=frame.timestamp,
            T_wc=result.T_wc,
            verdict=result.verdict,
            reason=result.reason,
            overlap=result.overlap,
            rmse=result.rmse,
            keyframe=kind.value,
            tracking_ms=1e3 * (tracked - started),
            mapping_ms=1e3 * (mapped - tracked),
            mapping_iterations=len(losses),
            gaussians=self.map.count,
            loss=float(np.mean(losses)) if losses else float("nan"),
            late_ms=1e3 * late,
        )
        self.reports.append(report)
        return report
