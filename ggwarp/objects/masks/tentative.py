# SPDX-License-Identifier: Apache-2.0
"""Segments that may be objects of their own inside what the map takes for one.

A map begun by a mask that runs two objects together, or from too far away to tell a small one, shows the
wrong object where a later mask has a segment of its own. Such a segment is followed by points on its surface:
keyframes that show it again speak for it, keyframes that show it as part of the larger object against it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggwarp.objects.labels import Labels
from ggwarp.objects.masks.mask_view import PosedDepth
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64

_POINTS = 64
_SEEN = 0.3
_HIT = 0.6


@state_value
@dataclass(eq=False)
class Candidate:
    """A segment that may be an object; ``index`` is its class once it is taken for one."""

    points: Float64
    count: int = 1
    index: int | None = None


@dataclass
class Candidates(Stateful):
    """Those followed now.

    Attributes:
        views: keyframes that must show one before it is taken for an object.
    """

    STATE = ("_followed",)

    views: int
    _followed: list[Candidate] = field(default_factory=list)

    def follow(
        self, segments: Labels, open_segments: set[int], surface: PosedDepth
    ) -> list[tuple[int, Candidate]]:
        """Take in a keyframe; return (segment, candidate) for those that are objects by now.

        Args:
            segments: [h, w] segment of each pixel; negative: none.
            open_segments: segments that are no object of the map by themselves.
            surface: where the pixels are.
        """
        found: dict[int, Candidate] = {}
        for candidate in list(self._followed):
            segment = _hit(surface.look_up(candidate.points, segments), len(candidate.points))
            if segment is None:
                continue
            if segment in open_segments and segment not in found:
                candidate.count += 1
                found[segment] = candidate
            else:
                candidate.count -= 1
                if candidate.count < 1:
                    self._followed.remove(candidate)
        for segment in sorted(open_segments):
            points = surface.points(segments == segment, _POINTS)
            if segment in found:
                found[segment].points = points
            elif len(points):
                self._followed.append(Candidate(points))
        return [(s, c) for s, c in sorted(found.items()) if c.count >= self.views]


def _hit(labels: Labels, count: int) -> int | None:
    """Return the segment that most of ``labels`` [k], seen of ``count`` points, show; None: unclear."""
    if len(labels) < _SEEN * count or len(labels) == 0:
        return None
    values, counts = np.unique(labels, return_counts=True)
    best = int(counts.argmax())
    return int(values[best]) if counts[best] > _HIT * len(labels) else None
