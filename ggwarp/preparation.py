# SPDX-License-Identifier: Apache-2.0
"""What a run needs before its first frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ggwarp.config import ConfigError, RunConfig
from ggwarp.console import Display
from ggwarp.datasets import Dataset, FrameReader
from ggwarp.map.submap import MapBudget
from ggwarp.pipeline.earlier_map import EmptyMapError
from ggwarp.pipeline.scheduler import LiveScheduler, Scheduler, UncappedScheduler
from ggwarp.pipeline.slam import Slam
from ggwarp.results.record import RunRecord
from ggwarp.results.saved_run import SavedRun
from ggwarp.runtime import loading
from ggwarp.runtime.image_store import ImageStore


def load_kernels(device: str, display: Display) -> None:
    """Load every kernel imported so far, and say so when they must be compiled first."""
    modules = loading.imported_kernel_modules(device)
    cold = loading.uncompiled(modules, device)
    display.stage(f"compiling kernels (first run only): {len(cold)} modules" if cold else "loading kernels")
    loading.load(modules, device)


def build_system(
    config: RunConfig,
    reader: FrameReader,
    budget: int,
    folder: Callable[[], Path],
    display: Display,
    earlier: SavedRun | None = None,
) -> Slam:
    """Return the system of a run, before its first frame.

    Args:
        reader: of the frames that it is to process.
        budget: bytes for the images of keyframes, and where ``--memory`` is given for the map, half each.
        folder: tells where what is beyond it goes.
        earlier: the run in whose map it begins; None: with an empty map.

    Raises:
        ConfigError: there is nothing in the earlier map to find a frame by.
    """
    if earlier is not None:
        load_kernels(config.device, display)  # it is looked at from all over
        size, objects = len(earlier.gaussians), len(earlier.objects)
        display.note(f"beginning in the map of {earlier.folder}: {size} Gaussians, {objects} objects")
        if objects and not config.slam.use_identity:
            display.warn(f"objects are not learnt: those of {earlier.folder} are left behind")
    try:
        return _slam(config, reader, budget, folder, earlier)
    except EmptyMapError as error:
        raise ConfigError(f"--start-from {error}") from None


def _slam(
    config: RunConfig,
    reader: FrameReader,
    budget: int,
    folder: Callable[[], Path],
    earlier: SavedRun | None,
) -> Slam:
    # What is drawn of a map depends on what of it is there: only who asks for less gets less.
    whole = config.memory is None
    map_budget = None if whole else MapBudget(budget // 2, folder)
    images = ImageStore(device=config.device, budget=budget if whole else budget - budget // 2, folder=folder)
    return Slam(
        config.slam,
        reader.camera,
        reader.sensor_camera,
        device=config.device,
        scheduler=_scheduler(config, len(reader)),
        images=images,
        map_budget=map_budget,
        earlier=earlier,
    )


def new_record(name: str, dataset: Dataset, config: RunConfig, plan: dict[str, Any]) -> RunRecord:
    """Return the record of a run of the sequence ``name`` before its first frame; ``plan``: as it has it."""
    # The objects of untracked masks are numbered by the map.
    names = getattr(dataset, "class_names", {}) if config.slam.masks_kind == "tracked" else {}
    monocular = config.slam.mono
    return RunRecord(name, dataset.kind, config.device, class_names=names, monocular=monocular, plan=plan)


def _scheduler(config: RunConfig, frames: int) -> Scheduler | None:
    """Return what paces a run of so many ``frames``; None: a fixed amount of mapping a frame."""
    if config.fps is None:
        return None
    return UncappedScheduler() if config.fps == "uncapped" else LiveScheduler(config.fps, frames=frames)


def works_concurrently(config: RunConfig, slam: Slam) -> bool:
    """Return whether to track beside the mapper.

    Raises:
        ConfigError: it is asked for, but tracking needs what is being mapped.
    """
    if config.pipelined == "on" and slam.sequential_only:
        raise ConfigError(
            "--pipelined on: here tracking looks at the Gaussians being mapped, and works in turn with "
            "mapping; leave the option out"
        )
    if config.pipelined == "auto":
        return config.fps == "uncapped" and not slam.sequential_only
    return config.pipelined == "on"
