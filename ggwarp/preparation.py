# SPDX-License-Identifier: Apache-2.0
"""What a run needs before its first frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ggwarp.config import ConfigError, RunConfig
from ggwarp.console import Display
from ggwarp.datasets import FrameReader
from ggwarp.pipeline.scheduler import LiveScheduler, Scheduler, UncappedScheduler
from ggwarp.pipeline.slam import Slam
from ggwarp.runtime import loading
from ggwarp.runtime.image_store import ImageStore


def load_kernels(device: str, display: Display) -> None:
    """Load every kernel imported so far, and say so when they must be compiled first."""
    modules = loading.imported_kernel_modules(device)
    cold = loading.uncompiled(modules, device)
    display.stage(f"compiling kernels (first run only): {len(cold)} modules" if cold else "loading kernels")
    loading.load(modules, device)


def build_system(config: RunConfig, reader: FrameReader, budget: int, folder: Callable[[], Path]) -> Slam:
    """Return the system of a run, before its first frame.

    Args:
        reader: of the frames that it is to process.
        budget: bytes for the images of keyframes.
        folder: tells where those go that are beyond it.
    """
    return Slam(
        config.slam,
        reader.camera,
        reader.sensor_camera,
        device=config.device,
        scheduler=_scheduler(config, len(reader)),
        images=ImageStore(device=config.device, budget=budget, folder=folder),
    )


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
