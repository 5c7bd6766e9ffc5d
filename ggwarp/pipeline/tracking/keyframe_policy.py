# SPDX-License-Identifier: Apache-2.0
"""Which frames enter the map: by overlap (GG-SLAM) or by covisibility (MonoGS)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from ggwarp.geometry import sim3
from ggwarp.map.covisibility import Look, intersection_over_union
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64, TrackResult, Verdict


@state_value
class KeyframeKind(Enum):
    """What a frame adds to the map."""

    NONE = ""
    TRACKING = "tracking"
    """Trackable Gaussians, and Gaussians for the picture."""
    MAPPING = "mapping"
    """Gaussians for the picture only: the tracker's target stays small."""


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe."""

    overlap: float = 0.95
    """A frame is a tracking keyframe when the share of its points with a map match closer than
    the tracker's overlap distance is below this."""
    mapping_interval: int = 4
    """Every N-th frame since the last tracking keyframe is a mapping keyframe."""


class KeyframePolicy(Protocol):
    """Decides which frames enter the map.

    Attributes:
        needs_gaussians: whether it looks at the Gaussians being mapped, and so works in turn with the mapper.
    """

    needs_gaussians: bool

    @property
    def empty(self) -> bool:
        """Whether no frame has entered the map yet."""
        ...

    def decide(self, result: TrackResult) -> KeyframeKind:
        """Return what the frame behind ``result`` adds; call once a frame, in order."""
        ...

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Take note that the last keyframe's pose [4, 4] was corrected."""
        ...

    def on_map_moved(self, motion: Float64) -> None:
        """Take note that the map was moved, here by ``motion`` [4, 4] of the world."""
        ...


class OverlapKeyframes(Stateful):
    """GS-ICP-SLAM's policy: overlap with the map, and a fixed interval in between."""

    STATE = ("_since_tracking",)
    needs_gaussians = False

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._since_tracking: int | None = None

    @property
    def empty(self) -> bool:
        """Whether no frame has entered the map yet."""
        return self._since_tracking is None

    def decide(self, result: TrackResult) -> KeyframeKind:
        """Return what the frame behind ``result`` adds; call once a frame, in order."""
        if result.verdict is Verdict.LOST:
            return KeyframeKind.NONE
        if self._since_tracking is None or result.overlap < self._config.overlap:
            self._since_tracking = 0
            return KeyframeKind.TRACKING
        self._since_tracking += 1
        due = self._since_tracking % self._config.mapping_interval == 0
        return KeyframeKind.MAPPING if due else KeyframeKind.NONE

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Nothing here depends on where keyframes are."""

    def on_map_moved(self, motion: Float64) -> None:
        """Nothing here depends on where the map is."""


@dataclass(frozen=True)
class CovisibilityConfig:
    """When a frame becomes a keyframe by what it sees of the map (MonoGS)."""

    interval: int = 4
    """A keyframe comes at least N frames after the last one."""
    overlap: float = 0.95
    """A moved frame is a keyframe when what it sees and what the last one sees share less than this (IoU)."""
    min_translation: float = 0.02
    """A frame has moved when it is farther from the last keyframe than this share of the median depth."""
    translation: float = 0.04
    """A frame farther away than this share of the median depth is a keyframe, whatever it sees."""


class CovisibilityKeyframes(Stateful):
    """Decides by what frames see of the map (MonoGS section 3.3.1)."""

    STATE = ("_last", "_since")
    needs_gaussians = True

    def __init__(self, config: CovisibilityConfig, look: Look) -> None:
        self._config = config
        self._look = look
        self._last: Float64 | None = None
        self._since = 0

    @property
    def empty(self) -> bool:
        """Whether no frame has entered the map yet."""
        return self._last is None

    def decide(self, result: TrackResult) -> KeyframeKind:
        """Return what the frame behind ``result`` adds; call once a frame, in order."""
        self._since += 1
        if result.verdict is Verdict.LOST or not self._due(result.T_wc):
            return KeyframeKind.NONE
        self._last, self._since = result.T_wc, 0
        # Without depth there are no points to register to.
        return KeyframeKind.MAPPING if result.points is None else KeyframeKind.TRACKING

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Take note that the last keyframe's pose was corrected to ``T_wc`` [4, 4]."""
        self._last = T_wc

    def on_map_moved(self, motion: Float64) -> None:
        """Take note that the map was moved, here by ``motion`` [4, 4] of the world."""
        self._last = None if self._last is None else sim3.moved_pose(motion, self._last)

    def _due(self, T_wc: Float64) -> bool:
        c = self._config
        if self._last is None:
            return True
        if self._since < c.interval:
            return False
        here = self._look(T_wc)
        if not np.isfinite(here.median_depth):
            return True  # nothing of the map is in view
        distance = float(np.linalg.norm(T_wc[:3, 3] - self._last[:3, 3])) / here.median_depth
        if distance > c.translation:
            return True
        if distance <= c.min_translation:
            return False
        return intersection_over_union(here.seen, self._look(self._last).seen) < c.overlap
