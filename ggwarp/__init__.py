# SPDX-License-Identifier: Apache-2.0
"""Object-level RGB-D Gaussian-splatting SLAM on NVIDIA Warp kernels."""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # not typing's: the command hears no signal before this module is imported
if TYPE_CHECKING:
    from typing import Any

    from ggwarp.config import RunConfig
    from ggwarp.datasets import FrameReader, SyntheticOffice, open_dataset
    from ggwarp.geometry.camera import Camera
    from ggwarp.pipeline.slam import Slam, SlamConfig
    from ggwarp.results.saved_run import RunError, SavedRun, load_run
    from ggwarp.types import Frame, Rendered, StepReport, TrackResult, Verdict

__version__ = "0.2.0"

__all__ = [
    "Camera",
    "Frame",
    "FrameReader",
    "Rendered",
    "RunConfig",
    "RunError",
    "SavedRun",
    "Slam",
    "SlamConfig",
    "StepReport",
    "SyntheticOffice",
    "TrackResult",
    "Verdict",
    "__version__",
    "load_run",
    "open_dataset",
]

# Each is imported when first asked for, so that `import ggwarp` costs nothing.
_HOMES = {
    "Camera": "ggwarp.geometry.camera",
    "RunConfig": "ggwarp.config",
    "FrameReader": "ggwarp.datasets",
    "SyntheticOffice": "ggwarp.datasets",
    "open_dataset": "ggwarp.datasets",
    "Slam": "ggwarp.pipeline.slam",
    "SlamConfig": "ggwarp.pipeline.slam",
    **dict.fromkeys(["RunError", "SavedRun", "load_run"], "ggwarp.results.saved_run"),
    **dict.fromkeys(["Frame", "Rendered", "StepReport", "TrackResult", "Verdict"], "ggwarp.types"),
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
