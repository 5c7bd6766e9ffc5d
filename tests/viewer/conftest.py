# SPDX-License-Identifier: Apache-2.0
"""A small run folder, see :mod:`small_run`."""

from pathlib import Path

import pytest

from ggwarp.map.gaussians import Gaussians
from small_run import wall_and_cubes, write_small_run


@pytest.fixture(scope="session")
def scene() -> Gaussians:
    return wall_and_cubes()


@pytest.fixture
def run_folder(scene: Gaussians, tmp_path: Path) -> Path:
    return write_small_run(tmp_path / "run", scene)
