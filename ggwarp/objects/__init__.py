# SPDX-License-Identifier: Apache-2.0
"""The objects of a map: learning them, listing them, and editing a saved run.

::

    from ggwarp import objects

    run = objects.load_run("runs/latest")
    mug = run.find("mug")
    chosen = objects.select(run.gaussians, mug.id)
    T = objects.motion_about(mug.centre, rotation=np.eye(3), translation=[0.2, 0.0, 0.0])
    moved = objects.move(run.gaussians, chosen, T)
    objects.save_run(run.edited(moved, {"edit": "move", "id": mug.id}), "runs/office-moved")

``python -m ggwarp.objects RUN ...`` does the same from the shell.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ggwarp.objects.edit import extract, join, motion_about, move, recolour, relabel, remove
    from ggwarp.objects.filling import FillConfig, fill_removed
    from ggwarp.objects.inpainting import inpaint_opencv, inpaint_shade
    from ggwarp.objects.inventory import ObjectRecord
    from ggwarp.objects.saved import RunError, SavedRun, load_run, save_run
    from ggwarp.objects.selection import SelectionConfig, select
    from ggwarp.objects.view import MapView, best_views

__all__ = [
    "FillConfig",
    "MapView",
    "ObjectRecord",
    "RunError",
    "SavedRun",
    "SelectionConfig",
    "best_views",
    "extract",
    "fill_removed",
    "inpaint_opencv",
    "inpaint_shade",
    "join",
    "load_run",
    "motion_about",
    "move",
    "recolour",
    "relabel",
    "remove",
    "save_run",
    "select",
]

_HOMES = {
    "edit": ["extract", "join", "motion_about", "move", "recolour", "relabel", "remove"],
    "filling": ["FillConfig", "fill_removed"],
    "inpainting": ["inpaint_opencv", "inpaint_shade"],
    "inventory": ["ObjectRecord"],
    "saved": ["RunError", "SavedRun", "load_run", "save_run"],
    "selection": ["SelectionConfig", "select"],
    "view": ["MapView", "best_views"],
}
_HOME_OF = {name: f"ggwarp.objects.{home}" for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    # Each is imported when first asked for: the parts of this package that SLAM uses stay light.
    if name in _HOME_OF:
        return getattr(importlib.import_module(_HOME_OF[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
