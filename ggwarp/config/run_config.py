# SPDX-License-Identifier: Apache-2.0
"""The options of a run, and what they alone show to be wrong."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ggwarp.datasets.base import MaskChoice
from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.io.printable import shown
from ggwarp.pipeline.slam_config import SlamConfig

Preset = Literal["gg-slam", "gs-icp", "monogs", "fast", "quality"]


_LARGEST = 2**31 - 1
"""Of any option: kernels count with 32 bits."""


class ConfigError(ValueError):
    """An option cannot be used: one line for the user, with the option, the value and the remedy."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides a run."""

    seq: str | None = None
    """The recording: a name under the data root, or its folder; office, wall and apartment are built in."""

    data: Path | None = None
    """The data root. Default: $GGWARP_DATA, else ./data."""

    frames: str | None = None
    """The frames to use, A:B or A:B:STEP. Default: all of them."""

    masks: str | None = None
    """A folder of object masks, one a frame, or none for no masks. Default: those beside the images, if any.
    The word untracked means those, with --masks-kind untracked."""

    masks_void: tuple[int, ...] = ()
    """Ids of masks' pixels that say nothing, such as 255 along borders."""

    intrinsics: tuple[float, float, float, float] | None = None
    """The camera of your own recording: fx fy cx cy in pixels of its native size. Default: its camera file's.
    A whole number is a pixel's centre."""

    preset: Preset = "gg-slam"
    """The values that all other options start from. gs-icp learns no objects; monogs tracks by rendering and
    fits poses with the map; fast and quality map less and more."""

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = field(default_factory=SlamConfig)

    refine: int = 0
    """Mapping iterations after the last frame."""

    device: str = "auto"
    """The device to compute on: cpu, cuda:N, or auto for CUDA if there is one."""

    scale: float | None = None
    """The image scale, above 0 and at most 1. Default: 1 on CUDA, about 50,000 pixels on a CPU."""

    fps: float | Literal["uncapped"] | None = None
    """Live mode: frames arrive so many times a second. The word uncapped means whenever the tracker is ready.
    Default: every frame waits for a fixed amount of mapping."""

    pipelined: Literal["auto", "on", "off"] = "auto"
    """Track and map at the same time, in two threads. The word auto means with --fps uncapped."""

    memory: float | None = None
    """Gigabytes for the map, for keyframes' images and for frames kept for the evaluation. Beyond them images
    and what of the map is out of view go to temporary files beside the results, and frames are read again.
    Default: a third of the machine's memory, and all of the map."""

    out: Path | None = None
    """The run folder. Default: runs/SEQ/UTC-TIME, linked as runs/latest."""

    save_renders: int | None = None
    """Save renders of every N-th frame, 0 for none. Default: of about ten frames."""

    built_in: SensorFaults = field(default_factory=SensorFaults)
    """What is wrong with the camera of a built-in scene; by default nothing is."""

    @property
    def mask_choice(self) -> MaskChoice:
        """What :func:`ggwarp.datasets.open_dataset` takes as ``masks``."""
        return MaskChoice(None if self.masks == "untracked" else self.masks, self.masks_void)

    def data_root(self) -> Path:
        """Return the folder that sequences are looked up in."""
        return self.data or Path(os.environ.get("GGWARP_DATA") or "data")


def check(config: RunConfig) -> None:
    """Refuse what the options alone show to be wrong.

    Raises:
        ConfigError: names the option, its value and the remedy.
    """
    if not config.seq:
        raise ConfigError("--seq is missing: give a sequence's name or its folder, such as --seq office0")
    if config.slam.tracker == "photometric" and config.slam.policy == "overlap":
        raise ConfigError("--policy overlap: --tracker photometric keeps no points; choose covisibility")
    if config.scale is not None and not 0.0 < config.scale <= 1.0:
        raise ConfigError(f"--scale {config.scale:g}: give a number above 0 and at most 1")
    if isinstance(config.fps, float) and not 0.0 < config.fps < math.inf:
        raise ConfigError(f"--fps {config.fps:g}: give a number above 0, or uncapped")
    if config.memory is not None and not 0.0 <= config.memory < math.inf:
        raise ConfigError(f"--memory {config.memory:g}: give a number of gigabytes, at least 0")
    if config.refine < 0:
        raise ConfigError(f"--refine {config.refine}: give 0 or a positive number of iterations")
    if config.save_renders is not None and config.save_renders < 0:
        raise ConfigError(f"--save-renders {config.save_renders}: give 0 or a positive number")
    if config.data is not None and not config.data.is_dir():
        raise ConfigError(f"--data {config.data}: no such folder")
    frame_slice(config.frames)
    check_numbers(dataclasses.replace(config, intrinsics=None))  # which are compared with the images


def check_numbers(config: Any, prefix: str = "--") -> None:
    """Refuse numbers below 0 or beyond all bounds, which no option of ``config`` or its parts takes.

    Raises:
        ConfigError: names the option, its value and the range.
    """
    for field_ in dataclasses.fields(config):
        value, name = getattr(config, field_.name), prefix + field_.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            check_numbers(value, prefix if field_.name == "slam" else f"{name}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not 0 <= number <= _LARGEST:
                raise ConfigError(f"{name} {shown(number)}: give a number from 0 to {_LARGEST:g}")


def frame_slice(text: str | None) -> slice:
    """Return the slice that A:B:STEP means; each part may be empty.

    Raises:
        ConfigError: it is not of that form, or STEP is not positive.
    """
    if text is None:
        return slice(None)
    try:
        parts = [int(p) if p.strip() else None for p in text.split(":")]
    except ValueError:
        parts = []
    if not 2 <= len(parts) <= 3:
        raise ConfigError(f"--frames {text}: expected A:B or A:B:STEP in whole numbers, such as 0:200:2")
    if len(parts) == 3 and parts[2] is not None and parts[2] < 1:
        raise ConfigError(f"--frames {text}: STEP is {parts[2]}, but at least 1 is needed")
    return slice(*parts)
