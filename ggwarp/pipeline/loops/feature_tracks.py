# SPDX-License-Identifier: Apache-2.0
"""Features of one camera's views, followed from view to view: which of them show the same point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.bundle_adjustment import Observations
from ggwarp.pipeline.loops.features import match_descriptors
from ggwarp.pipeline.loops.places import Looking
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64

_BACK = (1, 2, 3, 4, 6, 8, 12, 16)
"""A view is matched with those that many views before it."""

REACH = _BACK[-1]

_FEWEST, _SHARE = 12, 0.5
"""Matches of two views that fit one motion, at least, and of all."""

_EPIPOLAR = 1.0
"""Pixels that a match may lie off its epipolar line."""


@state_value
@dataclass
class FeatureView(Looking):
    """A picture whose pose is adjusted.

    Attributes:
        index: its frame's. T_wc: [4, 4] its pose as it is now.
        pixels: [n, 2] (u, v) of its features. descriptors: [n, 128] uint8 of these.
        tracks: [n] the point that each shows; -1: none that another view shows.
        depths: [n] of these points by the poses and the map as they are now; nan: not known.
        depth: the median of them, or of an earlier view's where there are none.
    """

    index: int
    T_wc: Float64
    pixels: Float64
    descriptors: NDArray[np.uint8]
    tracks: NDArray[np.intp]
    depths: Float64
    depth: float


class FeatureTracks(Stateful):
    """Views in order, and the points that their features show.

    Attributes:
        views: all of them.
        count: points so far.
    """

    STATE = ("views", "count")

    def __init__(self, camera: Camera) -> None:
        """``camera``: of all the pictures."""
        self._camera = camera
        self.views: list[FeatureView] = []
        self.count = 0

    def add(self, view: FeatureView) -> None:
        """Take in the next view, and find its features in those before it."""
        self.views.append(view)
        for back in _BACK:
            if back < len(self.views):
                earlier = self.views[-1 - back]
                self.join(earlier, view, self.matches(earlier, view))

    def matches(self, one: FeatureView, other: FeatureView) -> NDArray[np.intp]:
        """Return [m, 2] rows of two views' features that look alike and fit one motion; none where few do."""
        none = np.zeros((0, 2), np.intp)
        pairs = match_descriptors(one.descriptors, other.descriptors)
        if len(pairs) < _FEWEST:
            return none
        here, there = one.pixels[pairs[:, 0]], other.pixels[pairs[:, 1]]
        essential, fits = cv2.findEssentialMat(
            here, there, self._camera.matrix, cv2.USAC_MAGSAC, 0.999, _EPIPOLAR
        )
        if essential is None or fits is None:
            return none
        fits = fits[:, 0] > 0
        return pairs[fits] if fits.sum() >= max(_FEWEST, _SHARE * len(pairs)) else none

    def observations(self, numbers: Sequence[int]) -> tuple[Observations, NDArray[np.intp]]:
        """Return what views ``numbers`` show, counted anew, and [count] which points that are."""
        rows = [np.flatnonzero(self.views[number].tracks >= 0) for number in numbers]
        views = np.repeat(np.arange(len(numbers)), [len(r) for r in rows])
        tracks = np.concatenate([self.views[n].tracks[r] for n, r in zip(numbers, rows, strict=True)])
        pixels = np.concatenate([self.views[n].pixels[r] for n, r in zip(numbers, rows, strict=True)])
        points, numbered = np.unique(tracks, return_inverse=True)
        return Observations(views, numbered, pixels), points

    def join(self, earlier: FeatureView, view: FeatureView, pairs: NDArray[np.intp]) -> None:
        """Let matched features show the same point, unless that makes a view show one twice."""
        shown, shown_before = set(view.tracks.tolist()), set(earlier.tracks.tolist())
        for row, column in pairs.tolist():
            before, now = int(earlier.tracks[row]), int(view.tracks[column])
            if before < 0 and now < 0:
                before = now = self.count
                self.count += 1
            elif before < 0 and now not in shown_before:
                before = now
            elif now < 0 and before not in shown:
                now = before
            elif before != now and self._merge(before, now):
                shown.add(before)
                continue
            else:
                continue
            earlier.tracks[row], view.tracks[column] = before, now
            shown_before.add(before)
            shown.add(now)

    def _merge(self, kept: int, gone: int) -> bool:
        """Let two points be one, and say so, unless a view shows both."""
        holders = [v.tracks for v in self.views if gone in v.tracks]
        if any(kept in tracks for tracks in holders):
            return False
        for tracks in holders:
            tracks[tracks == gone] = kept
        return True
