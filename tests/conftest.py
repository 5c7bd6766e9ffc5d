# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: devices, generators, the folder of real recordings."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import settings

wp.config.log_level = wp.LOG_WARNING
# No test measures time: a first example may compile a kernel, and a machine may be busy.
settings.register_profile("ggwarp", deadline=None)
settings.load_profile("ggwarp")

DEVICES = ["cpu"] + (["cuda:0"] if torch.cuda.is_available() else [])


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the development recordings; tests that need it skip where it is absent."""
    root = Path(os.environ.get("GGWARP_TEST_DATA", Path(__file__).parents[1] / "../shared/data")).resolve()
    if not root.is_dir():
        pytest.skip(f"no recordings at {root}: set GGWARP_TEST_DATA to a folder that holds them")
    return root
