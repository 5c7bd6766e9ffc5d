# SPDX-License-Identifier: Apache-2.0
"""The views of an earlier map that it is fitted to: what of them is no longer there."""

from __future__ import annotations

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.pipeline.mapping.keyframe import Keyframes
from ggwarp.pipeline.moving_pixels import Bools, GonePixels
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Frame

_SURFACE = 0.05
"""A Gaussian lies on a view's surface where their depths differ by no more than this share."""


class EarlierViews(Stateful):
    """Holds new keyframes against an earlier map's views, and takes out what they see through."""

    def __init__(self, gaussians: GaussianMap, keyframes: Keyframes, camera: Camera) -> None:
        """Know no view yet; those of ``camera`` become ``keyframes``, before any new one."""
        self._map, self._keyframes, self._camera = gaussians, keyframes, camera
        self._gone = GonePixels(camera, device=gaussians.device)

    def add(self, view: Frame, T_wc: Float64) -> None:
        """Take in the last keyframe: a ``view`` of the earlier map from ``T_wc`` [4, 4]."""
        assert view.depth is not None, "of a render"
        self._gone.begin(len(self._keyframes) - 1, view.depth, T_wc)

    def take_out_what_is_gone(self, depth: Float32, T_wc: Float64) -> None:
        """Compare the views with a new keyframe, ``depth`` [h, w] from ``T_wc`` [4, 4].

        What it and another one see through is bound by no view any more, and its Gaussians go.
        """
        for number, pixels in self._gone.add(depth, T_wc).items():
            surface = self._keyframes.depth(number).copy()
            if self._keyframes.leave_out(number, pixels):
                self._drop_gaussians(number, pixels, surface)

    def state(self) -> State:
        """Return the votes; the views are those of the earlier map."""
        return self._gone.state()

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take over the votes on the same views."""
        self._gone.restore(state, frames)

    def _drop_gaussians(self, number: int, pixels: Bools, surface: Float32) -> None:
        """Remove the earlier map's Gaussians that view ``number`` shows at ``pixels`` [h, w]."""
        means, born = (to_host(self._map.fields[n])[: self._map.count] for n in ("means", "keyframe_ids"))
        x = se3.transform_points(se3.inverse(self._keyframes.pose(number)), means)
        rows, columns, inside = self._camera.pixels_of(x)
        near = np.abs(x[:, 2] - surface[rows, columns]) <= _SURFACE * surface[rows, columns]
        earlier = np.array([origin.is_earlier for origin in self._keyframes.origins])[born]
        gone = earlier & inside & near & pixels[rows, columns]
        self._map.keep(wp.array((~gone).astype(np.int32), dtype=int, device=self._map.device))
