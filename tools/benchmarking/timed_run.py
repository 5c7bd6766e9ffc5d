# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarking.timed_run TIMES.json OPTIONS...``: ``ggwarp.run`` with its stages clocked."""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ggwarp.run
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.pipeline.tracking.gicp import GicpTracker
from ggwarp.pipeline.tracking.given_poses import GivenPoses
from ggwarp.pipeline.tracking.hybrid import HybridTracker
from ggwarp.pipeline.tracking.monocular import MonocularTracker
from ggwarp.pipeline.tracking.photometric import PhotometricTracker

STAGES: dict[str, list[tuple[type, str]]] = {
    "tracking": [
        (tracker, method)
        for tracker in (GicpTracker, PhotometricTracker, HybridTracker, MonocularTracker, GivenPoses)
        for method in ("start", "track")
    ],
    "insertion": [(Mapper, "insert")],
    "mapping": [(Mapper, "iterate"), (Mapper, "synchronise")],
}
"""Stage -> the methods whose time is its own."""


class Clock:
    """Adds up the seconds spent in some methods, calls from within each other counted once."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth = 0

    def around(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``method``, clocked."""

        @functools.wraps(method)
        def clocked(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            self._depth += 1
            try:
                return method(*args, **kwargs)
            finally:
                self._depth -= 1
                if self._depth == 0:
                    self.seconds += time.perf_counter() - started

        return clocked


def main(times: Path, arguments: list[str]) -> int:
    """Run the command; write stage -> seconds to ``times`` and return its exit code."""
    clocks = {stage: Clock() for stage in STAGES}
    for stage, methods in STAGES.items():
        for owner, name in methods:
            setattr(owner, name, clocks[stage].around(getattr(owner, name)))
    code = ggwarp.run.main(arguments)
    times.write_text(json.dumps({stage: clock.seconds for stage, clock in clocks.items()}))
    return code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
