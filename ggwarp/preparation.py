# SPDX-License-Identifier: Apache-2.0
"""What a run needs before its first frame."""

from __future__ import annotations

from ggwarp.config import ConfigError, RunConfig
from ggwarp.console import Display
from ggwarp.pipeline.scheduler import LiveScheduler, Scheduler, UncappedScheduler
from ggwarp.pipeline.slam import Slam
from ggwarp.runtime import loading


def load_kernels(device: str, display: Display) -> None:
    """Load every kernel imported so far, and say so when they must be compiled first."""
    modules = loading.imported_kernel_modules(device)
    cold = loading.uncompiled(modules, device)
    display.stage(f"compiling kernels (first run only): {len(cold)} modules" if cold else "loading kernels")
    loading.load(modules, device)


def scheduler_of(config: RunConfig, frames: int) -> Scheduler | None:
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
