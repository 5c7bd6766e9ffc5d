# SPDX-License-Identifier: Apache-2.0
"""What of a keyframe contradicts the map or other keyframes, and what becomes of that."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.map.submaps import Submaps
from ggwarp.pipeline.mapping.earlier_views import EarlierViews
from ggwarp.pipeline.mapping.keyframe import Keyframes
from ggwarp.pipeline.mapping.unusable_pictures import unusable
from ggwarp.pipeline.moving_pixels import Bools, MovingPixels
from ggwarp.runtime.state import Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64, Frame

_ENOUGH = 12_500
"""Pixels that say whether half a picture is of no use: shares are known to half a percent."""

_log = logging.getLogger(__name__)


class Contradictions(Stateful):
    """Leaves out pictures that are of no use, pixels that move, and what is gone of an earlier map.

    Attributes:
        left_out: pictures_left_out, pixels_left_out of those mapped, and keyframe_pixels, theirs in all.
    """

    STATE = ("left_out", "_moving", "_earlier")

    def __init__(
        self, gaussians: GaussianMap, keyframes: Keyframes, camera: Camera, submaps: Submaps
    ) -> None:
        """Know no view yet; those of ``camera`` become ``keyframes``."""
        self._map, self._keyframes, self._camera, self._submaps = gaussians, keyframes, camera, submaps
        self._grid = PixelGrid.of(camera, _ENOUGH)
        self._moving = MovingPixels(camera, device=gaussians.device)
        self._earlier = EarlierViews(gaussians, keyframes, camera)
        self.left_out = {"pictures_left_out": 0, "pixels_left_out": 0, "keyframe_pixels": 0}

    def add_earlier(self, view: Frame, T_wc: Float64) -> None:
        """Take in the last keyframe: a ``view`` of an earlier map from ``T_wc`` [4, 4]."""
        self._earlier.add(view, T_wc)

    def find(self, frame: Frame, T_wc: Float64, renderer: Renderer | None) -> Bools | None:
        """Return the pixels [h, w] that contradict the rest, and leave out what they disprove; None: all.

        Args:
            frame: the next keyframe, with depth.
            T_wc: [4, 4] its pose.
            renderer: has rendered the map from there; None while the map is empty.
        """
        assert frame.depth is not None
        if renderer is not None and (reason := self._unusable(frame, renderer)):
            self.left_out["pictures_left_out"] += 1
            _log.warning("frame %d is not mapped: %s", frame.index, reason)
            return None
        self._earlier.take_out_what_is_gone(frame.depth, T_wc)
        number = len(self._keyframes)
        moved = self._moving.add(number, frame.depth, T_wc)
        wrong = moved.pop(number, np.zeros(frame.depth.shape, bool))
        for earlier, pixels in moved.items():
            self._leave_out(earlier, pixels)
        return wrong

    def _unusable(self, frame: Frame, renderer: Renderer) -> str:
        """Say why ``frame``, from where the map was rendered, is not to be mapped; empty: it is."""
        thinned, depth = self._grid.thinned, frame.depth
        few = replace(frame, rgb=thinned(frame.rgb), depth=None if depth is None else thinned(depth))
        return unusable(few, renderer.picture(self._grid.step))

    def leave_out_of_the_last(self, wrong: Bools) -> None:
        """Take the pixels [h, w] that were found out of the keyframe, which is now the last."""
        self._leave_out(len(self._keyframes) - 1, wrong)
        self.left_out["keyframe_pixels"] += wrong.size

    def move(self, motion_of: Callable[[int], Float64]) -> None:
        """Follow a correction: the motion [4, 4] of the world, by a keyframe's number."""
        self._moving.move(motion_of)

    def _leave_out(self, number: int, pixels: Bools) -> None:
        """Take ``pixels`` [h, w] out of keyframe ``number``, and the Gaussians that it added there."""
        if not (new := self._keyframes.leave_out(number, pixels)):
            return
        self.left_out["pixels_left_out"] += new
        self._submaps.hold_view(number)
        means, born = (to_host(self._map.fields[n])[: self._map.count] for n in ("means", "keyframe_ids"))
        T_cw = se3.inverse(self._keyframes.pose(number))
        rows, columns, inside = self._camera.pixels_of(se3.transform_points(T_cw, means))
        gone = (born == number) & inside & pixels[rows, columns]
        self._map.keep(wp.array((~gone).astype(np.int32), dtype=int, device=self._map.device))
