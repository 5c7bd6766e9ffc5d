# SPDX-License-Identifier: Apache-2.0
"""What a run's configuration leaves open, resolved for a data set and a machine."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from ggwarp.config.run_config import ConfigError, RunConfig, frame_slice
from ggwarp.datasets import Dataset
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.pose_graph import solver_is_there
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.results.saved_run import SavedRun

_CPU_PIXELS = 50_000  # what two cores can map at a few frames a second
_MIN_SIDE = 16  # pixels: one tile
_RENDERED_FRAMES = 10  # of a run, where nothing else is asked for


def resolve_config(config: RunConfig, dataset: Dataset, *, earlier: SavedRun | None = None) -> RunConfig:
    """Return ``config`` with nothing left open: device, scale, renders, and what ``dataset`` has not got.

    Without depth the system is monocular. Without masks no objects are learnt: the picture gets the time.

    Args:
        earlier: the run in whose map it begins, and whose objects are kept, if there is one.

    Raises:
        ConfigError: an option does not fit the data set or this machine.
    """
    if dataset.kind != "synthetic" and config.built_in != type(config.built_in)():
        raise ConfigError(f"--built-in.*: {config.seq} is a recording; only the built-in scenes take faults")
    slam = config.slam
    if config.masks == "untracked":
        slam = dataclasses.replace(slam, masks_kind="untracked")
    if slam.mono or not dataset.has_depth:
        slam = monocular(slam)
    if earlier is not None and (slam.mono or slam.tracker == "ground-truth"):
        why = "colour alone has no scale" if slam.mono else "--tracker ground-truth has a world of its own"
        raise ConfigError(f"--start-from {earlier.folder}: the camera is found by depth and colour; {why}")
    objects = dataset.has_masks or (earlier is not None and bool(earlier.objects))
    slam = dataclasses.replace(slam, use_identity=slam.use_identity and objects)
    device = device_name(config.device)
    frames = len(frame_indices(config.frames, len(dataset)))
    renders = config.save_renders
    return dataclasses.replace(
        config,
        slam=slam,
        device=device,
        scale=image_scale(config.scale, dataset.camera, device),
        save_renders=max(1, -(-frames // _RENDERED_FRAMES)) if renders is None else renders,
    )


def monocular(config: SlamConfig) -> SlamConfig:
    """Return ``config`` for frames without depth: options left at their defaults become those that fit.

    Poses come by colour. Views are adjusted together by their features (``loops``); without that, poses are
    fitted with the map, in a window. Gaussians keep their rates, as the poses that they follow still move.
    Mapping has them begin round and move faster.
    """
    mapper, default = config.mapper, MapperConfig()
    adjusted = config.loops and solver_is_there()
    changes: dict[str, Any] = {
        "iterations": 16,
        "pose_rates": default.pose_rates if adjusted else (5e-4, 5e-4),
        "rate_decay": 0.0,
        "exposure_rate": 0.01,
    }
    left = {name: value for name, value in changes.items() if getattr(mapper, name) == getattr(default, name)}
    return dataclasses.replace(
        config,
        mono=True,
        tracker="photometric",
        policy="covisibility",
        use_identity=False,
        mapper=dataclasses.replace(mapper, **left),
    )


def frame_indices(text: str | None, count: int) -> range:
    """Return the frames that ``text`` picks from a sequence of ``count``.

    Raises:
        ConfigError: it picks none.
    """
    indices = range(count)[frame_slice(text)]
    if not indices:
        raise ConfigError(f"--frames {text}: no frame left; the sequence has {count}, numbered from 0")
    return indices


def device_name(wanted: str) -> str:
    """Return the device that ``wanted`` means on this machine.

    Raises:
        ConfigError: there is no such device.
    """
    import warp as wp

    cuda = [d.alias for d in wp.get_cuda_devices()]
    if wanted == "auto":
        return cuda[0] if cuda else "cpu"
    name = "cuda:0" if wanted == "cuda" else wanted
    if name not in ["cpu", *cuda]:
        raise ConfigError(f"--device {wanted}: no such device; this machine has {', '.join(['cpu', *cuda])}")
    return name


def image_scale(wanted: float | None, camera: Camera, device: str) -> float:
    """Return the image scale to use for pictures of ``camera``.

    Raises:
        ConfigError: the pictures would be too small.
    """
    if wanted is not None:
        scale = wanted
    elif device == "cpu":
        twentieths = round(20 * math.sqrt(_CPU_PIXELS / (camera.width * camera.height)))
        scale = min(max(twentieths, 1), 20) / 20
    else:
        scale = 1.0
    size = camera.scaled(scale)
    if min(size.width, size.height) < _MIN_SIDE:
        raise ConfigError(
            f"--scale {scale:g}: images of {size.width}x{size.height} are too small; "
            f"at least {_MIN_SIDE} pixels a side are needed"
        )
    return scale
