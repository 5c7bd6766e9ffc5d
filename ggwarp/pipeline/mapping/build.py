# SPDX-License-Identifier: Apache-2.0
"""An empty map and its mapper, with the parts that a run's settings ask for."""

from __future__ import annotations

from typing import Any

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.objects.object_learning import ObjectLearning
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig


def build_mapper(
    config: MapperConfig,
    camera: Camera,
    *,
    device: Any,
    use_identity: bool,
    tracked_masks: bool = True,
    window: WindowConfig | None = None,
    monocular: bool = False,
    recorded: bool | None = None,
) -> Mapper:
    """Return the mapper of an empty map.

    Args:
        use_identity: learn which object each Gaussian is of.
        tracked_masks: whether the masks' ids mean the same object in every frame.
        camera, window, monocular, recorded: as of :class:`ggwarp.pipeline.mapping.mapper.Mapper`.
    """
    gaussians = GaussianMap(device=device, has_identity=use_identity)
    objects = (
        ObjectLearning(
            config.supervision,
            config.classifier,
            camera,
            gaussians,
            seed=config.seed,
            tracked_masks=tracked_masks,
        )
        if use_identity
        else None
    )
    return Mapper(
        config, camera, gaussians, objects=objects, window=window, monocular=monocular, recorded=recorded
    )
