# SPDX-License-Identifier: Apache-2.0
"""Tracking by rendering the map (MonoGS): depth helps but is not needed, no points are kept."""

from __future__ import annotations

from typing import Any

from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.motion_model import MotionModel
from ggwarp.pipeline.tracking.pose_refinement import Refined, RefinementConfig, Refiner
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult, Verdict

_RENDERS = 3
"""Renders of an alignment at most."""

_SURE_COST = 2.5
"""A frame whose colours fit worse is also tried from the last good pose; if they still do, it is poor."""

_MAX_JUMP, _MAX_TURN = 0.3, 0.4
"""A frame farther from its prediction is poor, metres and radians."""


class PhotometricTracker(Stateful):
    """Finds the pose at which the map looks like the frame; never reads ``Frame.T_wc``.

    Depth is compared, too, where frames have it.
    """

    STATE = ("_refiner", "_motion")
    needs_gaussians = True

    def __init__(self, refinement: RefinementConfig, renderer: Renderer, *, device: Any = "cpu") -> None:
        """Make a tracker of frames whose pictures ``renderer``'s camera took."""
        self._refiner = Refiner(refinement, renderer, renders=_RENDERS, device=device)
        self._motion: MotionModel | None = None

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given."""
        self._motion = MotionModel.at_rest(T_wc, frame.timestamp)
        return TrackResult(self._motion.T_wc, Verdict.CONVERGED)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame.

        Args:
            target: not looked at: the Gaussians themselves are.

        Raises:
            RuntimeError: there was no :meth:`start`.
        """
        if self._motion is None:
            raise RuntimeError("track() before start(): the first frame's pose must be given")
        predicted = self._motion.predict(frame.timestamp)
        found = self._refiner.refine(frame, predicted, with_depth=True)
        if found.cost > _SURE_COST or found.objection:
            found = min(found, self._refiner.refine(frame, self._motion.T_wc, with_depth=True), key=_rank)
        if found.objection:
            self._motion.lost += 1
            return TrackResult(predicted, Verdict.LOST, found.objection, overlap=found.share)
        reason = self._doubt(found, predicted)
        self._motion = self._motion.updated(found.T_wc, frame.timestamp)
        verdict = Verdict.POOR if reason else Verdict.CONVERGED
        return TrackResult(found.T_wc, verdict, reason, exposure=found.as_exposure(), overlap=found.share)

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Take note that the last frame's pose [4, 4] was corrected by the mapper."""
        if self._motion is not None:
            self._motion.T_wc = T_wc

    def _doubt(self, found: Refined, predicted: Float64) -> str:
        """Return why the pose is poor, one clause; empty: it is not."""
        assert self._motion is not None
        if jump := self._motion.jump(found.T_wc, predicted, _MAX_JUMP, _MAX_TURN):
            return jump
        if found.cost > _SURE_COST:
            return f"the picture differs from the map by {found.cost:.1f} noise variances a pixel"
        return ""


def _rank(found: Refined) -> tuple[bool, float]:
    return bool(found.objection), found.cost
