# SPDX-License-Identifier: Apache-2.0
"""The presets, and configurations read from files, which start from one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ggwarp.config.run_config import ConfigError, RunConfig
from ggwarp.io.suggestion import did_you_mean
from ggwarp.io.toml import TomlError, merged, read_toml
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.pipeline.tracking.tracker import TrackerError


def preset_config(name: str) -> RunConfig:
    """Return the configuration that the preset ``name`` stands for.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in _PRESETS:
        meant = did_you_mean(name, _PRESETS)
        raise ConfigError(f"--preset {name}: no such preset{meant}; choose one of {', '.join(_PRESETS)}")
    config = RunConfig()
    slam = _PRESETS[name](config.slam)
    return dataclasses.replace(config, slam=slam, preset=name)  # pyright: ignore[reportArgumentType]


def _with_iterations(factor: float) -> Callable[[SlamConfig], SlamConfig]:
    def change(config: SlamConfig) -> SlamConfig:
        iterations = max(1, round(factor * config.mapper.iterations))
        return dataclasses.replace(config, mapper=dataclasses.replace(config.mapper, iterations=iterations))

    return change


def _fast(config: SlamConfig) -> SlamConfig:
    """Two iterations a frame on about half the Gaussians, and three quarters of the tracked points."""
    mapper = config.mapper
    return dataclasses.replace(
        config,
        gicp=dataclasses.replace(config.gicp, points=6000),
        mapper=dataclasses.replace(
            mapper,
            iterations=2,
            seeding=dataclasses.replace(mapper.seeding, min_density=0.12, max_density=0.3),
        ),
    )


def _monogs(config: SlamConfig) -> SlamConfig:
    """Tracking by rendering, a covisible window fitted with its poses: 150 iterations in six frames."""
    mapper = dataclasses.replace(
        config.mapper,
        iterations=25,
        bootstrap=150,
        pose_rates=(1e-3, 1e-3),
        isotropic_weight=2.0,
        rate_decay=0.0,
    )
    return dataclasses.replace(
        config, tracker="photometric", policy="covisibility", use_identity=False, mapper=mapper
    )


_PRESETS: dict[str, Callable[[SlamConfig], SlamConfig]] = {
    "gg-slam": lambda config: config,
    "gs-icp": lambda config: dataclasses.replace(config, use_identity=False),
    "monogs": _monogs,
    "fast": _fast,
    "quality": _with_iterations(3.0),
}


def load_config(path: Path) -> RunConfig:
    """Read a saved configuration, or any part of one; what is left out has its preset's value.

    Raises:
        ConfigError: the file is missing or not TOML, or a key is unknown or of the wrong type.
    """
    try:
        return config_of(read_toml(path), str(path))
    except TomlError as error:
        raise ConfigError(f"--config {error}") from None
    except TrackerError as error:
        raise ConfigError(f"--config {path}: tracker: {error}") from None


def config_of(values: dict[str, Any], where: str) -> RunConfig:
    """Return the configuration with ``values``, the others as their preset has them.

    Raises:
        ConfigError: there is no such preset.
        TomlError: a key is unknown or of the wrong type; ``where`` begins the message.
        TrackerError: there is no such tracker.
    """
    return merged(preset_config(str(values.get("preset", "gg-slam"))), values, where=where)
