# SPDX-License-Identifier: Apache-2.0
"""What a run without depth changes in its configuration."""

from __future__ import annotations

import dataclasses
from typing import Any

from ggwarp.config import RunConfig
from ggwarp.pipeline.mapping.mapper import MapperConfig


def monocular(config: RunConfig) -> RunConfig:
    """Return ``config`` for frames without depth: options left at their defaults become those that fit.

    Poses come by colour and are fitted with the map, in a window; Gaussians begin round, move faster and
    keep their rates, as the poses that they follow still move.
    """
    mapper, default = config.mapper, MapperConfig()
    changes: dict[str, Any] = {
        "rates": dataclasses.replace(default.rates, means=3e-4),
        "iterations": 16,
        "pose_rates": (5e-4, 5e-4),
        "rate_decay": 0.0,
        "exposure_rate": 0.01,
        "seeding": dataclasses.replace(default.seeding, flatness=1.0, max_stretch=1.0),
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
