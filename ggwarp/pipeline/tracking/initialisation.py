# SPDX-License-Identifier: Apache-2.0
"""How a monocular map begins: with two pictures that differ by enough parallax."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.two_views import (
    Matcher,
    Matches,
    filled,
    grey,
    pose_from_depth,
    relative_pose,
    triangulate,
)
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64, Frame

TRIAL = 10
"""Frames after a start that show whether it was good: when two are lost or poor, it starts over."""

PATIENCE = 30
"""Frames without parallax after which a start is given up for the newest picture."""

_KNOWN = 0.4
"""The map begins when the depth of this share of the first picture can be told."""

_DEPTH_TOLERANCE = 0.1
"""Told means: to this share of it."""

_AGREEING = 0.8
"""Share of the matches that must fit one motion; else the start is bad."""

_MATCHED = 0.35
"""Share of the first picture that must be in view; else the wait was in vain, and starts over."""


@dataclass(frozen=True)
class InitialisationConfig:
    """At which scale a monocular map begins."""

    median_depth: float = 2.0
    """Median depth of the first picture, metres: it sets the scale, which one camera cannot know."""


@dataclass(frozen=True)
class Initialisation:
    """A start.

    Attributes:
        T_wc: [4, 4] pose of the newest frame. depth: [h, w] of its picture, metres, everywhere.
        poses: index -> [4, 4] pose of each frame since the first.
    """

    T_wc: Float64
    depth: Float32
    poses: dict[int, Float64]


class MonocularInitialiser(Stateful):
    """Waits for parallax between a first picture and a later one.

    Attributes:
        waiting_for: why the map has not begun, one clause.
        restarts: how often the first picture was given up for a newer one.
    """

    STATE = ("_frames", "waiting_for", "restarts")

    def __init__(self, config: InitialisationConfig, camera: Camera) -> None:
        """``camera``: of all the pictures."""
        self._config = config
        self._camera = camera
        self._matcher = Matcher()
        self._frames: list[Frame] = []
        self.waiting_for = ""
        self.restarts = 0

    def add(self, frame: Frame, T_first: Float64) -> Initialisation | None:
        """Take in the next frame; return the start when there is one.

        Args:
            T_first: [4, 4] pose that the first picture is to have.
        """
        self._frames.append(frame)
        if len(self._frames) == 1:
            self.waiting_for = "the first picture of one camera: depth will come with motion"
            return None
        first = self._frames[0]
        matches = self._matcher.match(grey(first.rgb), grey(frame.rgb))
        if matches.share < _MATCHED:
            return self._over("the first picture was out of view before its depth was known")
        motion = relative_pose(matches, self._camera)
        if motion is None or motion[1] < _AGREEING:
            return self._wait("the pictures do not fit one motion")
        begun = self._judged(matches, motion[0], T_first)
        return begun if begun is not None else self._wait("too little parallax yet")

    def _wait(self, reason: str) -> None:
        self.waiting_for = reason
        if len(self._frames) > PATIENCE:
            self._over(f"{reason}, after {PATIENCE} frames")

    def _over(self, reason: str) -> None:
        """Begin again with the newest picture."""
        self.waiting_for = f"{reason}; starting over"
        self._frames = self._frames[-1:]
        self.restarts += 1

    def _judged(self, matches: Matches, T_other: Float64, T_first: Float64) -> Initialisation | None:
        """Return the start that this motion [4, 4] to the newest picture makes; None: too uncertain."""
        newest = self._frames[-1]
        seen = triangulate(matches, T_other, self._camera)
        known = seen.known(_DEPTH_TOLERANCE)
        if known.mean() < _KNOWN:
            return None
        T_other = T_other.copy()
        T_other[:3, 3] *= self._config.median_depth / np.median(seen.depth()[known])
        seen = triangulate(matches, T_other, self._camera)
        depth = np.where(seen.known(_DEPTH_TOLERANCE), seen.depth(), np.float32(0.0))
        poses = self._between(depth, T_other, T_first)
        back = self._matcher.match(grey(newest.rgb), grey(self._frames[0].rgb))
        here = triangulate(back, se3.inverse(T_other), self._camera)
        depth_here = np.where(here.known(_DEPTH_TOLERANCE), here.depth(), np.float32(0.0))
        return Initialisation(poses[newest.index], filled(depth_here), poses)

    def _between(self, depth: Float32, T_last: Float64, T_first: Float64) -> dict[int, Float64]:
        """Return the pose [4, 4] of every frame since the first, whose depth is known in part."""
        first, *others, last = self._frames
        poses = {first.index: T_first, last.index: T_first @ se3.inverse(T_last)}
        before = np.eye(4)
        for frame in others:
            matches = self._matcher.match(grey(first.rgb), grey(frame.rgb))
            found = pose_from_depth(matches, depth, self._camera, before)
            before = before if found is None else found[0]
            poses[frame.index] = T_first @ se3.inverse(before)
        return poses
