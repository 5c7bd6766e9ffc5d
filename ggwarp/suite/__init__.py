# SPDX-License-Identifier: Apache-2.0
"""Suites: many runs from one file, each in a process of its own, on one machine or many, and their tables."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ggwarp.suite.definition import Suite, SuiteError
    from ggwarp.suite.execution import execute, open_site
    from ggwarp.suite.job import Job, Resources
    from ggwarp.suite.pool import LocalPool, Pool
    from ggwarp.suite.ray_pool import RayPool
    from ggwarp.suite.results import Results
    from ggwarp.suite.suite_file import load_suite

__all__ = [
    "Job",
    "LocalPool",
    "Pool",
    "RayPool",
    "Resources",
    "Results",
    "Suite",
    "SuiteError",
    "execute",
    "load_suite",
    "open_site",
]

_HOMES = {
    **dict.fromkeys(["Suite", "SuiteError"], "definition"),
    **dict.fromkeys(["Job", "Resources"], "job"),
    **dict.fromkeys(["LocalPool", "Pool"], "pool"),
    "RayPool": "ray_pool",
    "Results": "results",
    "load_suite": "suite_file",
    **dict.fromkeys(["execute", "open_site"], "execution"),
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"ggwarp.suite.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
