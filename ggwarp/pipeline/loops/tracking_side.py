# SPDX-License-Identifier: Apache-2.0
"""Loops on the tracker's side: whether a run closes them, and what of tracking follows when it does."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ggwarp.geometry import sim3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.loop_closer import Closure, LoopCloser, Scope
from ggwarp.pipeline.loops.monocular_loops import MonocularLoops
from ggwarp.pipeline.loops.places import Place
from ggwarp.pipeline.loops.pose_graph import solver_is_there
from ggwarp.pipeline.loops.pose_uncertainty import PoseUncertainty
from ggwarp.pipeline.tracking.keyframe_policy import KeyframePolicy
from ggwarp.pipeline.tracking.monocular import MonocularTracker
from ggwarp.pipeline.tracking.point_map import TrackableMap
from ggwarp.pipeline.tracking.tracker import FollowsMap, Tracker, TrackingConfig
from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64, Frame, TrackResult


class TrackingLoops(Stateful):
    """Closes loops of the tracker's side, if the run closes any, and keeps count of the drift between them.

    Attributes:
        stay_open: why loops stay open, one clause; empty: they are closed.
    """

    STATE = ("_closer", "_uncertainty")

    def __init__(
        self,
        config: TrackingConfig,
        cameras: tuple[Camera, Camera],
        tracker: Tracker,
        policy: KeyframePolicy,
        points: TrackableMap,
        images: ImageStore | None = None,
    ) -> None:
        """Know no place yet.

        Args:
            cameras: of the frames' pictures and of their sensor depth.
            tracker, policy, points: what follows.
            images: those of the keyframes; what places show goes where these go.
        """
        self._tracker, self._policy, self._points = tracker, policy, points
        self.stay_open = _why_not(tracker, config.loops)
        self._uncertainty = PoseUncertainty()
        # The map takes no notice of points that move by less.
        least = points.distance
        self._closer: LoopCloser | MonocularLoops | None = None
        if not self.stay_open:
            self._closer = (
                MonocularLoops(cameras[0])
                if isinstance(tracker, MonocularTracker)
                else LoopCloser(
                    *cameras,
                    config.gicp.depth_noise,
                    least_move=least,
                    device=points.device,
                    folder=None if images is None else images.folder,
                )
            )

    def adopt(self, places: Sequence[Place]) -> None:
        """See :meth:`ggwarp.pipeline.loops.loop_closer.LoopCloser.adopt`."""
        if isinstance(self._closer, LoopCloser):
            self._closer.adopt(places)

    def close(
        self,
        frame: Frame,
        result: TrackResult,
        scope: Scope,
        *,
        is_keyframe: bool,
    ) -> tuple[TrackResult, Closure | None, float]:
        """Take in a tracked frame; return it as corrected, the loop that it closes, and the seconds spent.

        Args:
            scope: of work on the device.
            is_keyframe: later frames will be registered to it.
        """
        closure, before = None, 0.0
        if self._closer is not None:
            before = self._closer.seconds
            closure = self._closer.observe(frame, result, scope)
        if closure is not None:
            motion = self._follow(closure, frame.index, scope)
            result = dataclasses.replace(result, T_wc=sim3.moved_pose(motion, result.T_wc))
        std = self._uncertainty.position_std(frame.index, result, is_keyframe=is_keyframe, closure=closure)
        seconds = 0.0 if self._closer is None else self._closer.seconds - before
        return dataclasses.replace(result, position_std=std), closure, seconds

    def finish(self, scope: Scope) -> Closure | None:
        """Return the loop that the last frame closes, if it does, where no frame will follow."""
        closure = self._closer.finish(scope) if isinstance(self._closer, LoopCloser) else None
        if closure is not None:
            self._follow(closure, closure.frame, scope)
        return closure

    def _follow(self, closure: Closure, index: int, scope: Scope) -> Float64:
        """Move what tracking rests on; return the motion [4, 4] of the world at ``index``, the last frame."""
        [motion] = closure.correction.at([index])
        assert isinstance(self._tracker, FollowsMap)
        with scope():
            self._points.move(closure.correction)
            self._tracker.on_map_moved(closure.correction, index)
        self._policy.on_map_moved(motion)
        return motion


def _why_not(tracker: Tracker, wanted: bool) -> str:
    if not wanted:
        return "--no-loops"
    if not isinstance(tracker, FollowsMap):
        return "the tracker keeps no points that could be moved"
    if not solver_is_there():
        return "GTSAM is not installed: pip install 'gtsam>=4.3' (Linux and macOS, Python 3.11 or newer)"
    return ""
