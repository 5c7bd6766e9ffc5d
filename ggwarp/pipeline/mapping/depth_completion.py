# SPDX-License-Identifier: Apache-2.0
"""Depth of a monocular keyframe: what the map shows, what recent pictures say, and the rest filled in."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.geometry.two_views import InverseDepth, Matcher, filled, fuse, grey, triangulate
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64, Frame, Rendered

_OPAQUE = 0.95
_LAGS = (1, 2, 4)
"""Depth is triangulated from the pictures that many frames ago."""
_TOLERANCE = 0.1
"""Triangulated depth counts where its standard deviation is below this share of it."""
_CONTRADICTION = 0.15
"""Triangulated depth goes before the map's where the two differ by more than this share."""


class DepthCompletion(Stateful):
    """Completes the depth of pictures from the map and from the pictures before them."""

    STATE = ("_recent",)

    def __init__(self, camera: Camera) -> None:
        """``camera``: of all the pictures."""
        self._camera = camera
        self._matcher = Matcher()
        self._recent: deque[tuple[int, NDArray[np.uint8], Float64]] = deque(maxlen=max(_LAGS))

    def observe(self, frame: Frame, T_wc: Float64) -> None:
        """Take in a picture and its pose [4, 4]: every frame, in order, after its depth was asked for."""
        self._recent.append((frame.index, grey(frame.rgb), T_wc))

    def move(self, correction: PoseCorrection) -> None:
        """Let the recent pictures follow where the map is moved."""
        for place, (index, picture, T_wc) in enumerate(self._recent):
            [motion] = correction.at([index])
            self._recent[place] = index, picture, sim3.moved_pose(motion, T_wc)

    def triangulated(self, frame: Frame, T_wc: Float64) -> InverseDepth:
        """Return what the recent pictures say of the depth of ``frame``, seen from ``T_wc`` [4, 4]."""
        here = grey(frame.rgb)
        nothing = np.zeros(here.shape, np.float32)
        estimates = [InverseDepth(nothing, nothing)]
        for lag in _LAGS:
            if lag <= len(self._recent):
                _, there, T_there = self._recent[-lag]
                matches = self._matcher.match(here, there)
                estimates.append(triangulate(matches, se3.inverse(T_there) @ T_wc, self._camera))
        return fuse(estimates)

    def complete(self, frame: Frame, T_wc: Float64, rendered: Rendered | None) -> Frame:
        """Return ``frame`` with depth everywhere, if it has none.

        Args:
            T_wc: [4, 4] its pose.
            rendered: the map's view from there; a frame without depth needs it.
        """
        if frame.depth is not None:
            return frame
        assert rendered is not None
        return replace(frame, depth=self.estimate(frame, T_wc, rendered))

    def estimate(self, frame: Frame, T_wc: Float64, rendered: Rendered) -> Float32:
        """Return the depth [h, w] of ``frame``, seen from ``T_wc`` [4, 4], metres, everywhere.

        Args:
            rendered: the map's view from there.
        """
        seen = self.triangulated(frame, T_wc)
        measured = np.where(seen.known(_TOLERANCE), seen.depth(), np.float32(0.0))
        shown = np.where(rendered.opacity > _OPAQUE, rendered.surface_depth, np.float32(0.0))
        contradicted = (shown > 0.0) & (measured > 0.0) & (np.abs(measured - shown) > _CONTRADICTION * shown)
        depth = np.where((shown > 0.0) & ~contradicted, shown, measured)
        return filled(depth)
