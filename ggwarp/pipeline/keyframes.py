# SPDX-License-Identifier: Apache-2.0
"""Which frames enter the map (GG-SLAM: tracking keyframes and mapping-only keyframes)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from ggwarp.types import Float64, TrackResult, Verdict


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
    """A frame is a mapping keyframe every so many frames since the last tracking keyframe."""


class KeyframePolicy(Protocol):
    """Decides which frames enter the map."""

    @property
    def empty(self) -> bool:
        """Whether no frame has entered the map yet."""
        ...

    def decide(self, result: TrackResult) -> KeyframeKind:
        """Return what the frame behind ``result`` adds; call once a frame, in order."""
        ...

    def moved(self, T_wc: Float64) -> None:
        """Take note that the last keyframe's pose [4, 4] was corrected."""
        ...


class OverlapKeyframes:
    """GS-ICP-SLAM's policy: overlap with the map, and a fixed interval in between."""

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

    def moved(self, T_wc: Float64) -> None:
        """Nothing here depends on where keyframes are."""
