# SPDX-License-Identifier: Apache-2.0
"""The objects of a map: learning them, listing them, and editing a saved run.

::

    from ggwarp import editing

    run = editing.load_run("runs/latest")
    mug = run.find("mug")
    chosen = editing.select(run.gaussians, mug.id)
    T = editing.motion_about(mug.centre, rotation=np.eye(3), translation=[0.2, 0.0, 0.0])
    moved = editing.move(run.gaussians, chosen, T)
    editing.save_run(run.edited(moved, {"edit": "move", "id": mug.id}), "runs/office-moved")

``python -m ggwarp.editing RUN ...`` does the same from the shell.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ggwarp.editing.edits import extract, merge, motion_about, move, recolour, relabel, remove, split
    from ggwarp.editing.inpaint.filling import FillConfig, fill_removed
    from ggwarp.editing.inpaint.image_inpainting import inpaint_opencv, inpaint_shade
    from ggwarp.editing.map_view import MapView, best_views
    from ggwarp.editing.selection import SelectionConfig, select
    from ggwarp.editing.trimming import trimmed
    from ggwarp.map.gaussians import join
    from ggwarp.objects.inventory import ObjectRecord
    from ggwarp.results.saved_run import RunError, SavedRun, load_run, save_run

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
    "merge",
    "motion_about",
    "move",
    "recolour",
    "relabel",
    "remove",
    "save_run",
    "select",
    "split",
    "trimmed",
]

_HOMES = {
    "edits": ["extract", "merge", "motion_about", "move", "recolour", "relabel", "remove", "split"],
    "inpaint.filling": ["FillConfig", "fill_removed"],
    "inpaint.image_inpainting": ["inpaint_opencv", "inpaint_shade"],
    "selection": ["SelectionConfig", "select"],
    "map_view": ["MapView", "best_views"],
    "trimming": ["trimmed"],
}
_HOME_OF = {name: f"ggwarp.editing.{home}" for home, names in _HOMES.items() for name in names}
_HOME_OF["ObjectRecord"] = "ggwarp.objects.inventory"
_HOME_OF |= dict.fromkeys(["RunError", "SavedRun", "load_run", "save_run"], "ggwarp.results.saved_run")
_HOME_OF["join"] = "ggwarp.map.gaussians"


def __getattr__(name: str) -> Any:
    # Each is imported when first asked for: the parts of this package that SLAM uses stay light.
    if name in _HOME_OF:
        return getattr(importlib.import_module(_HOME_OF[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
