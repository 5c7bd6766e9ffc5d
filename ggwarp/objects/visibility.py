# SPDX-License-Identifier: Apache-2.0
"""Which keyframes showed which object."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import counted
from ggwarp.objects.class_table import NO_OBJECT
from ggwarp.runtime.state import Stateful

_LEAST_SHARE = 1e-4  # of the image: less is a dot in a mask


@dataclass(frozen=True)
class VisibleFrames:
    """When an object was seen.

    Attributes:
        first, last: indices of the first and last keyframe that show it.
        views: how many keyframes show it.
    """

    first: int
    last: int
    views: int


class ObjectVisibility(Stateful):
    """The keyframes of every object, by any number."""

    STATE = ("_frames",)

    def __init__(self) -> None:
        self._frames: dict[int, set[int]] = {}

    def add(self, index: int, mask: NDArray[np.int32]) -> None:
        """Note that frame ``index`` shows the objects of ``mask`` [h, w] that cover more than a dot."""
        ids, counts = counted(mask.ravel())
        for identifier in ids[(counts > _LEAST_SHARE * mask.size) & (ids > NO_OBJECT)].tolist():
            self._frames.setdefault(identifier, set()).add(index)

    def renamed(self, names: NDArray[np.integer[Any]]) -> ObjectVisibility:
        """Return the same with object i as ``names[i]``; objects of one name are one."""
        out = ObjectVisibility()
        for number, frames in self._frames.items():
            out._frames.setdefault(int(names[number]), set()).update(frames)
        return out

    def of(self, ids: Iterable[int]) -> VisibleFrames | None:
        """Return when any of ``ids`` was seen; None: never."""
        frames = set().union(*(self._frames.get(i, set()) for i in ids))
        return VisibleFrames(min(frames), max(frames), len(frames)) if frames else None
