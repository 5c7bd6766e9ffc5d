# SPDX-License-Identifier: Apache-2.0
"""Tracking by depth and colour together: G-ICP to the map, direct alignment to views taken on the way."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.geometry.uncertainty import loosened, position_std
from ggwarp.pipeline.moving_pixels import Bools, FreeSpace, without_pixels
from ggwarp.pipeline.tracking.gicp import MAX_POSITION_STD, GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.motion_model import depth_time
from ggwarp.pipeline.tracking.reference_views import ReferenceViews, View
from ggwarp.runtime.state import Stateful
from ggwarp.solvers.alignment import Alignment
from ggwarp.solvers.pose_equations import Prior
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult, Verdict

_VELOCITY_DEVIATION = 0.1
"""Deviation of the velocity, metres and half radians a second: depth and colour are not taken at once."""

_ACCELERATION = (3.0, 20.0)
"""Deviation of a hand's acceleration, metres and radians a second squared."""

_SURE_POSITION_STD = 2e-4
"""Colour is asked where depth leaves the position more uncertain along some direction, metres."""

_MIN_SHARE = 0.15
"""A picture of which less can be compared with a view says nothing of the pose."""

_MAX_COST = 1.0
"""Nor does one that differs more: the robust cost of a pixel, in variances of a colour's noise."""

_DOUBTFUL = 1.5
"""A picture that differs by so many times what is usual may have been laid on its views wrongly."""

_FORGETTING = 0.1
"""Weight of the last frame in what is usual."""

_MAX_STD = 0.02
"""Nor does one that leaves the position more uncertain along some direction, metres."""

_MOST_MOVED = 0.5
"""Where more of a frame's readings seem to have moved, it is the pose that is wrong."""

_FEW_MOVED = 0.01
"""A smaller share of a frame is not worth another registration."""


class HybridTracker(Stateful):
    """One estimate from depth and colour, each weighed by what it leaves uncertain.

    G-ICP's pose is a prior of direct alignment to the latest views. How uncertain that prior is, is said by
    the 6x6 system and by the noise of the depth image itself, measured in it: with clean depth and geometry
    on all sides colour has nothing to add, and is not asked; on a wall, or with a Kinect, it has.
    """

    STATE = ("_gicp", "_views", "_cost", "_free_space")
    needs_gaussians = False

    def __init__(
        self, gicp: GicpConfig, camera: Camera, sensor_camera: Camera, *, device: Any = "cpu"
    ) -> None:
        """Make a tracker of frames with colour by ``camera`` and depth by ``sensor_camera``."""
        self._gicp = GicpTracker(gicp, sensor_camera, device=device)
        self._views = ReferenceViews(camera, device=device)
        self._cost = _MAX_COST
        self._free_space = FreeSpace(camera, device=device)

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given."""
        result = self._gicp.start(frame, T_wc)
        return result if result.verdict is Verdict.LOST else self._remembered(frame, frame, result)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame.

        Raises:
            RuntimeError: there was no :meth:`start`.
        """
        still, result = self._registered(frame, target)
        result = self._aligned(still, result)
        return result if result.verdict is Verdict.LOST else self._remembered(frame, still, result)

    def _registered(self, frame: Frame, target: MapSnapshot) -> tuple[Frame, TrackResult]:
        """Return ``frame`` without the readings of what moves, and its registration."""
        moved = self._moving_pixels(frame, self._gicp.predict(frame))
        still = without_pixels(frame, moved)
        result = self._gicp.track(still, target)
        if still is frame or result.verdict is Verdict.LOST:
            return still, result
        # Edges seem to move where the motion was not foreseen.
        again = self._moving_pixels(frame, result.T_wc)
        if np.count_nonzero(moved != again) > _FEW_MOVED * moved.size:
            still = without_pixels(frame, again)
            result = self._gicp.track_again(still, target)
        return still, result

    def _moving_pixels(self, frame: Frame, T_wc: Float64) -> Bools:
        """Return the pixels [h, w] that move if the camera is at ``T_wc`` [4, 4]."""
        assert frame.depth is not None, "tracked by depth"
        moved = self._free_space.seen_through(frame.depth, T_wc)
        if not moved.any():
            return moved
        readings = np.count_nonzero(frame.depth > 0.0)
        if np.count_nonzero(frame.depth[moved] > 0.0) > _MOST_MOVED * readings:
            return np.zeros_like(moved)
        return moved

    def _aligned(self, frame: Frame, result: TrackResult) -> TrackResult:
        """Return ``result`` by colour, too, where depth leaves the pose uncertain."""
        lost = result.verdict is Verdict.LOST
        # A lost frame's registration may have ended anywhere that geometry allows.
        prior = None if lost else self._prior(frame, result)
        if prior is not None and position_std(prior.information) <= _SURE_POSITION_STD:
            return result
        T_start = result.T_wc if prior is None else self._expected(frame, prior)
        views = self._views.compared(frame, T_start)
        found = self._views.align(frame, T_start, views, prior)
        if prior is not None and found.system.mean_cost > _DOUBTFUL * self._cost:
            result, found = self._by_colour_first(frame, result, views, found)
        if self._objection(found):
            return self._held_by_motion(frame, result, T_start)
        self._cost += _FORGETTING * (found.system.mean_cost - self._cost)
        verdict, reason = self._verdict(result, found)
        T_wc, exposure = se3.inverse(found.T_cw), self._views.exposure(found, views)
        self._gicp.correct(frame, T_wc)
        return dataclasses.replace(
            result,
            T_wc=T_wc,
            verdict=verdict,
            reason=reason,
            exposure=exposure,
            information=found.information,
        )

    def _by_colour_first(
        self, frame: Frame, result: TrackResult, views: list[View], found: Alignment
    ) -> tuple[TrackResult, Alignment]:
        """Look for a pose at which picture and views agree better, and register there.

        Depth that slides may end at a wrong place and hold it against colour.

        Args:
            result, found: by depth first; returned where nothing better is found.
        """
        T_start = self._predicted(frame)
        alone = self._views.align(frame, T_start, views, None)
        if self._objection(alone) or alone.system.mean_cost >= found.system.mean_cost:
            return result, found
        before, T_wc = (self._gicp.registration, self._gicp.information), se3.inverse(alone.T_cw)
        again = self._gicp.register_again(frame, T_wc)
        if again.verdict is not Verdict.LOST:
            better = self._views.align(frame, T_wc, views, self._prior(frame, again))
            if not self._objection(better) and better.system.mean_cost < found.system.mean_cost:
                return again, better
        self._gicp.registration, self._gicp.information = before
        return result, found

    def remember(self, frame: Frame, T_wc: Float64) -> None:
        """Know the view of ``frame`` from ``T_wc`` [4, 4], to find and check poses by."""
        self._gicp.remember(frame, T_wc)

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """The points that poses rest on stay where they are, whatever becomes of a keyframe's pose."""

    def on_map_moved(self, correction: PoseCorrection, index: int) -> None:
        """Follow the map, which a closed loop has moved; ``index``: of the last frame."""
        self._gicp.on_map_moved(correction, index)
        self._views.move(correction)
        self._free_space.move(correction.at([index])[0])

    def _remembered(self, frame: Frame, still: Frame, result: TrackResult) -> TrackResult:
        """Keep what later frames need of ``frame``, of which ``still`` does not move; return ``result``."""
        self._views.add_if_new(frame, still, result.T_wc, result.exposure)
        assert still.depth is not None, "tracked by depth"
        self._free_space.add(still.depth, result.T_wc)
        return result

    def _objection(self, found: Alignment) -> str:
        """Return why the picture says nothing of the pose, one clause; empty: it does."""
        share, cost = self._views.share_compared(found), found.system.mean_cost
        std = position_std(found.information)
        if share < _MIN_SHARE:
            return f"only {share:.2f} of the picture can be compared with earlier views"
        if cost > _MAX_COST:
            return f"the picture differs from earlier views by {cost:.1f} noise variances a pixel"
        if not std <= _MAX_STD:
            return f"depth and colour leave the position free to slide by {std:.3f} m"
        return ""

    def _verdict(self, result: TrackResult, found: Alignment) -> tuple[Verdict, str]:
        """Return the verdict on a pose by depth and colour: colour may hold what geometry lets slide."""
        if result.verdict is Verdict.LOST:
            return Verdict.POOR, f"by colour alone: {result.reason}"
        if position_std(self._gicp.information) > MAX_POSITION_STD >= position_std(found.information):
            return Verdict.CONVERGED, ""
        return result.verdict, result.reason

    def _expected(self, frame: Frame, prior: Prior) -> Float64:
        """Return the pose [4, 4] by registration, and by the motion before where depth lets it slide."""
        T_cw = se3.inverse(self._predicted(frame))
        dt = max(self._gicp.seconds_since_good(frame), 1e-3)
        deviations = 0.5 * dt**2 * np.repeat(_ACCELERATION, 3)
        motion = np.diag(1.0 / deviations**2)
        step = np.linalg.solve(
            prior.information + motion, motion @ se3.se3_log(T_cw @ se3.inverse(prior.T_cw))
        )
        return se3.inverse(se3.se3_exp(step) @ prior.T_cw)

    def _predicted(self, frame: Frame) -> Float64:
        """Return the pose [4, 4] by the motion before alone."""
        predicted = self._gicp.predicted
        assert predicted is not None, "it was tracked"
        return predicted @ self._gicp.to_colour(frame)

    def _held_by_motion(self, frame: Frame, result: TrackResult, T_wc: Float64) -> TrackResult:
        """Return ``result`` at the expected pose [4, 4] where depth lets it slide."""
        if result.verdict is Verdict.LOST or position_std(self._gicp.information) <= MAX_POSITION_STD:
            return result
        self._gicp.correct(frame, T_wc)
        return dataclasses.replace(result, T_wc=T_wc)

    def _prior(self, frame: Frame, result: TrackResult) -> Prior | None:
        """Return what the last registration says of the colour's pose; None where there was none."""
        fit = self._gicp.registration
        if fit is None or not np.isfinite(fit.information).all():
            return None
        gap = abs(frame.timestamp - depth_time(frame))
        information = loosened(self._gicp.information, _VELOCITY_DEVIATION * gap)
        return Prior(se3.inverse(fit.T_wc @ self._gicp.to_colour(frame)), information)
