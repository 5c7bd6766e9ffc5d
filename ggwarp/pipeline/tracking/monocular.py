# SPDX-License-Identifier: Apache-2.0
"""Tracking one camera without depth: the start by parallax, then by rendering the map."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.initialisation import InitialisationConfig, MonocularInitialiser
from ggwarp.pipeline.tracking.photometric import PhotometricConfig, PhotometricTracker
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult, Verdict


class MonocularTracker(PhotometricTracker):
    """Holds the first frames until their depth can be told, then tracks by colour.

    Attributes:
        init_failed: the map is not what the camera sees: the start was bad, and it must begin anew.
        poses: index -> [4, 4] pose of the frames up to the start, known only then.
    """

    def __init__(
        self,
        config: PhotometricConfig,
        start: InitialisationConfig,
        renderer: Renderer,
        *,
        device: Any = "cpu",
    ) -> None:
        """Make a tracker of frames whose pictures ``renderer``'s camera took."""
        super().__init__(config, renderer, device=device)
        self._start = MonocularInitialiser(start, renderer.camera)
        self._first: Float64 | None = None
        self._trial = start.trial
        self._tracked = self._lost = 0
        self.init_failed = False
        self.poses: dict[int, Float64] = {}

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the next frame of the start; it is lost until there is enough parallax.

        Args:
            T_wc: [4, 4] pose that the first frame is to have.
        """
        if self._first is None:
            self._first = np.array(T_wc, np.float64)
        begun = self._start.add(frame, self._first)
        if begun is None:
            return TrackResult(self._first, Verdict.LOST, self._start.waiting_for)
        self.poses = begun.poses
        super().start(frame, begun.T_wc)
        return TrackResult(begun.T_wc, Verdict.CONVERGED, depth=begun.depth)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame; soon after the start, being lost twice means that it was bad."""
        result = super().track(frame, target)
        self._tracked += 1
        self._lost += result.verdict is Verdict.LOST
        self.init_failed = self._lost > 1 and self._tracked <= self._trial
        return result
