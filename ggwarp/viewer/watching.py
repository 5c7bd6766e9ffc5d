# SPDX-License-Identifier: Apache-2.0
"""Who watches a run: nobody, unless a viewer is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.types import Frame, StepReport


class Watched(Protocol):
    """What a viewer sees of a SLAM system; it changes nothing of it."""

    map: GaussianMap
    camera: Camera
    mapping_scope: Any
    """A context in which the map may be looked at between frames."""

    def save(self, folder: str | Path, names: dict[int, str] | None = None) -> None:
        """Write what :func:`ggwarp.load_run` reads."""
        ...


class RunViewer(Protocol):
    """Shows a run while it goes on."""

    def begin(self, system: Watched, folder: Path) -> None:
        """Watch ``system``, whose results will be in ``folder``."""
        ...

    def show(self, frame: Frame, step: StepReport, stopped: Callable[[], bool]) -> float:
        """Show a processed frame; return the seconds that the user held the run up, until ``stopped``."""
        ...


class NoViewer:
    """Shows nothing, and costs nothing."""

    def begin(self, system: Watched, folder: Path) -> None:
        pass

    def show(self, frame: Frame, step: StepReport, stopped: Callable[[], bool]) -> float:
        return 0.0
