# SPDX-License-Identifier: Apache-2.0
"""A small run folder, see :mod:`small_run`, whose Gaussians are flat and turned in all directions."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ggwarp.map.gaussians import Gaussians
from small_run import wall_and_cubes, write_small_run


@pytest.fixture(scope="session")
def scene() -> Gaussians:
    rng = np.random.default_rng(4)
    plain = wall_and_cubes()
    quats = rng.normal(size=(len(plain), 4))
    return dataclasses.replace(
        plain,
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        log_scales=np.log(rng.uniform(0.01, 0.05, (len(plain), 3))).astype(np.float32),
        opacity_logits=rng.uniform(-1.0, 4.0, len(plain)).astype(np.float32),
    )


@pytest.fixture
def run_folder(scene: Gaussians, tmp_path: Path) -> Path:
    return write_small_run(tmp_path / "run", scene)
