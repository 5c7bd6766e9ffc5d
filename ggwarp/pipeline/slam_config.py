# SPDX-License-Identifier: Apache-2.0
"""The configuration of the whole system."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.tracking.keyframe_policy import CovisibilityConfig, KeyframeConfig
from ggwarp.pipeline.tracking.point_map import TrackableConfig
from ggwarp.pipeline.tracking.tracker import TrackingConfig


@dataclass(frozen=True)
class SlamConfig(TrackingConfig):
    """The whole system: its parts' configurations and what joins them."""

    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    trackable: TrackableConfig = field(default_factory=TrackableConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    policy: Literal["auto", "overlap", "covisibility"] = "auto"
    """How keyframes are chosen: by overlap with the trackable points, or by covisibility. The latter keeps a
    window that is fitted together (MonoGS). The word auto means covisibility with --tracker photometric."""
    covisibility: CovisibilityConfig = field(default_factory=CovisibilityConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    mono: bool = False
    """Leave depth images aside: the map has no scale of its own. Always so where there are none."""
    use_identity: bool = True
    """Learn which object each Gaussian belongs to (GG-SLAM); without, this is GS-ICP-SLAM."""
    masks_kind: Literal["tracked", "untracked"] = "tracked"
    """What the masks' ids say: tracked, the same object in every frame, or untracked, nothing across frames.
    Segmenters of single images write the latter; the map then finds the objects again."""
