# SPDX-License-Identifier: Apache-2.0
"""Tracking one camera without depth: the start by parallax, then by rendering the map."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.initialisation import TRIAL, InitialisationConfig, MonocularInitialiser
from ggwarp.pipeline.tracking.photometric import PhotometricTracker
from ggwarp.pipeline.tracking.pose_refinement import RefinementConfig
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult, Verdict


class MonocularTracker(PhotometricTracker):
    """Holds the first frames until their depth can be told, then tracks by colour."""

    STATE = (*PhotometricTracker.STATE, "_initialiser", "_first", "_tracked", "_doubted")

    def __init__(
        self,
        refinement: RefinementConfig,
        initialisation: InitialisationConfig,
        renderer: Renderer,
        *,
        device: Any = "cpu",
    ) -> None:
        """Make a tracker of frames whose pictures ``renderer``'s camera took."""
        super().__init__(refinement, renderer, device=device)
        self._initialiser = MonocularInitialiser(initialisation, renderer.camera)
        self._first: Float64 | None = None
        self._tracked = self._doubted = 0

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the next frame of the start; it is lost until there is enough parallax.

        Args:
            T_wc: [4, 4] pose that the first frame is to have.
        """
        if self._first is None:
            self._first = np.array(T_wc, np.float64)
        begun = self._initialiser.add(frame, self._first)
        if begun is None:
            return TrackResult(self._first, Verdict.LOST, self._initialiser.waiting_for)
        super().start(frame, begun.T_wc)
        return TrackResult(begun.T_wc, Verdict.CONVERGED, depth=begun.depth, earlier_poses=begun.poses)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame; two lost or poor soon after the start mean that it was bad."""
        result = super().track(frame, target)
        self._tracked += 1
        self._doubted += result.verdict is not Verdict.CONVERGED
        init_failed = self._doubted > 1 and self._tracked <= TRIAL
        return dataclasses.replace(result, reinitialise=init_failed)

    def on_map_moved(self, correction: PoseCorrection, index: int) -> None:
        """Take note that the map, and the poses of all frames up to the last, ``index``, were moved."""
        if self._motion is not None:
            [motion] = correction.at([index])
            self._motion.move(motion)
