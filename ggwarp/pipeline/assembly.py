# SPDX-License-Identifier: Apache-2.0
"""The parts that a configuration of the whole system asks for."""

from __future__ import annotations

from typing import Any

from ggwarp.geometry.camera import Camera
from ggwarp.map.submap import MapBudget
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.pipeline.tracking.keyframe_policy import CovisibilityKeyframes, KeyframePolicy, OverlapKeyframes
from ggwarp.runtime.image_store import ImageStore


def make_mapper(
    config: SlamConfig, camera: Camera, *, device: Any, images: ImageStore | None, budget: MapBudget | None
) -> Mapper:
    """Return the mapper of an empty map; for ``images`` and ``budget`` see :func:`build_mapper`."""
    return build_mapper(
        config.mapper,
        camera,
        device=device,
        use_identity=config.use_identity,
        tracked_masks=config.masks_kind == "tracked",
        window=config.window if config.policy == "covisibility" else None,
        monocular=config.mono,
        images=images,
        budget=budget,
    )


def make_policy(config: SlamConfig, mapper: Mapper) -> KeyframePolicy:
    """Return what chooses keyframes, before the first one."""
    if mapper.covisibility is not None:
        return CovisibilityKeyframes(config.covisibility, mapper.covisibility.look)
    return OverlapKeyframes(config.keyframes)
