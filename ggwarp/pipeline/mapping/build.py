# SPDX-License-Identifier: Apache-2.0
"""An empty map and its mapper, with the parts that a run's settings ask for."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.map.covisibility import Covisibility
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.map.submap import MapBudget
from ggwarp.map.submaps import Submaps
from ggwarp.objects.object_learning import ObjectLearning
from ggwarp.pipeline.mapping.depth_completion import DepthCompletion
from ggwarp.pipeline.mapping.exposure import ExposureModel
from ggwarp.pipeline.mapping.keyframe import Keyframes
from ggwarp.pipeline.mapping.keyframe_sampler import RandomSampler, WindowSampler
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.pipeline.mapping.optimiser import MONOCULAR_RATES, RATES, MapOptimiser
from ggwarp.runtime.image_store import ImageStore


def build_mapper(
    config: MapperConfig,
    camera: Camera,
    *,
    device: Any,
    use_identity: bool,
    tracked_masks: bool = True,
    window: WindowConfig | None = None,
    monocular: bool = False,
    rates: AdamRates | None = None,
    recorded: bool | None = None,
    images: ImageStore | None = None,
    budget: MapBudget | None = None,
) -> Mapper:
    """Return the mapper of an empty map.

    Args:
        camera: of the keyframes' images.
        use_identity: learn which object each Gaussian is of.
        tracked_masks: whether the masks' ids mean the same object in every frame.
        window: fit the keyframes of a covisible window together; None: draw from all.
        monocular: frames have no depth, or an estimate: it seeds the map, but does not bind it.
        rates: Adam's learning rates of the Gaussians; None: those of this kind of run.
        recorded: see :class:`ggwarp.pipeline.mapping.optimiser.MapOptimiser`.
        images: holds those of the keyframes, and is emptied; None: all stay in memory.
        budget: of the map; None: all of it stays on the device.
    """
    gaussians = GaussianMap(device=device, has_identity=use_identity)
    objects = None
    if use_identity:
        objects = ObjectLearning(
            config.supervision,
            config.classifier,
            camera,
            gaussians,
            seed=config.seed,
            tracked_masks=tracked_masks,
        )
    renderer = Renderer(gaussians, camera, identity_shapes=config.classifier.shapes)
    exposures = ExposureModel(renderer, rate=config.exposure_rate) if config.exposure_rate > 0.0 else None
    keyframes = Keyframes(ImageStore(device=device) if images is None else images)
    submaps = Submaps(gaussians, camera, budget)
    rng = np.random.default_rng(config.seed)
    covisibility = None if window is None else Covisibility(gaussians, camera)
    sampler = (
        RandomSampler(rng, submaps)
        if window is None or covisibility is None
        else WindowSampler(rng, window, covisibility.look, keyframes.pose, submaps)
    )
    optimiser = MapOptimiser(
        config,
        gaussians,
        renderer,
        None if objects is None else objects.classifier,
        keyframes,
        sampler,
        submaps,
        exposures=exposures,
        rates=rates or (MONOCULAR_RATES if monocular else RATES),
        recorded=recorded,
    )
    return Mapper(
        config,
        gaussians,
        renderer,
        keyframes,
        sampler,
        optimiser,
        submaps,
        objects=objects,
        covisibility=covisibility,
        exposures=exposures,
        depth_completion=DepthCompletion(camera) if monocular else None,
    )
