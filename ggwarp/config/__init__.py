# SPDX-License-Identifier: Apache-2.0
"""A run's configuration: the command's options and the owners' dataclasses, composed.

Every part of the system keeps its options beside it; here they come under one roof, get their presets, and
what was left open is resolved for a data set and a machine.
"""

from ggwarp.config.checkpoint_interval import CheckpointInterval
from ggwarp.config.presets import load_config, preset_config
from ggwarp.config.resolution import device_name, frame_indices, image_scale, monocular, resolve_config
from ggwarp.config.resumed_run import ResumedRun
from ggwarp.config.run_config import ConfigError, Preset, RunConfig, check

__all__ = [
    "CheckpointInterval",
    "ConfigError",
    "Preset",
    "ResumedRun",
    "RunConfig",
    "check",
    "device_name",
    "frame_indices",
    "image_scale",
    "load_config",
    "monocular",
    "preset_config",
    "resolve_config",
]
