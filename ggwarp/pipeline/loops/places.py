# SPDX-License-Identifier: Apache-2.0
"""Keyframes of the pose graph, and which earlier ones may show what the newest shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import se3
from ggwarp.pipeline.loops.features import Features
from ggwarp.pipeline.loops.recognition import VisualIndex
from ggwarp.pipeline.loops.surface_registration import Surface
from ggwarp.pipeline.tracking.relocalisation import SmallView
from ggwarp.runtime.state import state_value
from ggwarp.types import Float64

APART, APART_TURN = 0.1, 0.15
"""The next place begins where the camera is farther from the last than this share of the median depth, or
this many radians: the two then still share most of what they see."""

_NEAR = 1.0
"""Places are near whose views' centres are less far from each other than this share of their depth, the
angle between them added, radians: farther ones share too little."""

_BY_PLACE, _BY_LOOKS = 4, 3
"""So many earlier places are tried, the nearest ones and those that look most alike."""

_LEAST_SIMILARITY = 0.1
"""Places less alike are not tried (cosine of bags of words)."""

SEPARATE = 5
"""Candidates are so many places apart: one next to another adds nothing."""


class Looking:
    """A camera somewhere that looks at something; what it is a part of has ``T_wc`` [4, 4] and ``depth``."""

    T_wc: Float64
    depth: float

    @property
    def centre(self) -> Float64:
        """[3] what it looks at, world frame."""
        return self.T_wc[:3, 3] + self.depth * self.T_wc[:3, 2]

    def displacement(self, motion: Float64) -> float:
        """Return how far a motion [4, 4] of the world moves what it looks at, or itself, metres."""
        ends = np.stack([self.centre, self.T_wc[:3, 3]])
        return float(np.linalg.norm(se3.transform_points(motion, ends) - ends, axis=1).max())


@state_value
@dataclass
class PlacePose(Looking):
    """Where a keyframe of the pose graph is.

    Attributes:
        index: its frame's. T_wc: [4, 4] its pose as it is now.
        depth: median of what it sees, metres.
    """

    index: int
    T_wc: Float64
    depth: float


@dataclass
class Place(PlacePose):
    """A keyframe of the pose graph, with what it shows.

    Attributes:
        features: of its picture. view: the small one. surface: its points.
    """

    features: Features
    view: SmallView
    surface: Surface


def far_enough(last: PlacePose, T_wc: Float64) -> bool:
    """Return whether a frame at ``T_wc`` [4, 4] is another place than ``last``."""
    motion = se3.inverse(last.T_wc) @ T_wc
    turn = np.arccos(np.clip((np.trace(motion[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(np.linalg.norm(motion[:3, 3]) > APART * last.depth or turn > APART_TURN)


def candidates(places: Sequence[Looking], looks: VisualIndex, *, apart: int = SEPARATE) -> list[int]:
    """Return the numbers of earlier places that the last may show again.

    Args:
        apart: so many of the newest are left out, the last itself among them.
    """
    last = places[-1]
    earlier = places[: max(len(places) - apart, 0)]
    if not earlier:
        return []
    centres = np.stack([p.centre for p in earlier])
    axes = np.stack([p.T_wc[:3, 2] for p in earlier])
    far = np.linalg.norm(centres - last.centre, axis=1) / last.depth
    distances = far + np.arccos(np.clip(axes @ last.T_wc[:3, 2], -1.0, 1.0))
    similarities = looks.similarities()[: len(earlier)]
    near = _separate(-distances, _BY_PLACE, -_NEAR)
    alike = _separate(similarities, _BY_LOOKS, _LEAST_SIMILARITY)
    return sorted({*near, *alike})


def _separate(scores: Float64, most: int, least: float) -> list[int]:
    """Return up to ``most`` numbers with the highest ``scores`` above ``least``, apart from each other."""
    chosen: list[int] = []
    for number in np.argsort(-scores, kind="stable"):
        if scores[number] <= least or len(chosen) == most:
            break
        if all(abs(int(number) - other) >= SEPARATE for other in chosen):
            chosen.append(int(number))
    return chosen
