# SPDX-License-Identifier: Apache-2.0
"""One submap, and what of a map may be in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.view_volume import Bools
from ggwarp.map.cells import Cells
from ggwarp.runtime.state import state_value
from ggwarp.types import Float64


@dataclass(frozen=True)
class MapBudget:
    """What of a map may be in memory.

    Attributes:
        size: bytes of the Gaussians and of what rendering them takes.
        folder: tells where the file of the others will be, when it is first needed; None: the temporary one.
    """

    size: int
    folder: Callable[[], Path] | None = None


@state_value
@dataclass
class Submap:
    """What is known of a submap, parked or not.

    Attributes:
        middle: [3] what its first keyframe looks at, which it moves with, world frame.
        cells: where its Gaussians are; of one that is not parked, as of when it was last looked at.
        seen: when it was in view last, in views.
        parked: Gaussians that are in the file; 0: none, they are on the device.
        births: [b] the keyframes that brought those that are parked, rising.
        motions: how loops have moved these since then, [b, 4, 4] each.
        around: balls that hold the cells that it had when it was last parked, and some room.
        hides: [k] which of the keyframes before that may see any of these; of later ones none did.
    """

    middle: Float64
    cells: Cells
    seen: int
    around: Cells
    parked: int = 0
    births: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    motions: list[Float64] = field(default_factory=list)
    hides: Bools = field(default_factory=lambda: np.zeros(0, bool))
