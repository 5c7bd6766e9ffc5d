# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: devices, generators, the folder of real recordings."""

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import settings

from ggwarp.runtime.launch import cpu_threads, set_cpu_threads

wp.config.log_level = wp.LOG_WARNING
# No test measures time: a first example may compile a kernel, and a machine may be busy.
settings.register_profile("ggwarp", deadline=None)
settings.load_profile("ggwarp")

DEVICES = ["cpu"] + (["cuda:0"] if torch.cuda.is_available() else [])


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--reliability", action="store_true", help="run tests/reliability whole")


@pytest.fixture
def campaign(request: pytest.FixtureRequest) -> bool:
    """Whether a campaign is run whole, which takes minutes."""
    return request.config.getoption("--reliability")


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(autouse=True)
def log_as_it_was() -> Iterator[None]:
    """Take back where a test has let the package log to: its streams end with it."""
    log = logging.getLogger("ggwarp")
    handlers, level = list(log.handlers), log.level
    yield
    log.handlers, log.level = handlers, level


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


@pytest.fixture
def assert_same_on_any_threads() -> Callable[[Callable[[], Any]], None]:
    """Check that the arrays that a function returns do not change by a bit with the number of threads."""

    def check(run: Callable[[], Any]) -> None:
        threads, results = cpu_threads(), []
        try:
            for count in (1, 2, 3):
                set_cpu_threads(count)
                results.append(run())
        finally:
            set_cpu_threads(threads)
        for arrays in zip(*results, strict=True):
            for other in arrays[1:]:
                np.testing.assert_array_equal(arrays[0], other)

    return check
