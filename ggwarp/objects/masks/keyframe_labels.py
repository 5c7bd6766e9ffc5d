# SPDX-License-Identifier: Apache-2.0
"""The labels that keyframes came with, so that they can be labelled again."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.labels import Labels, as_runs, from_runs
from ggwarp.objects.masks.label_grid import changed
from ggwarp.runtime.state import Stateful


class KeyframeLabels(Stateful):
    """Knows the class of every pixel as each keyframe came with it, and whether a new label is news."""

    STATE = ("_given", "_learnt")

    def __init__(self, classes: ClassTable, grid: PixelGrid) -> None:
        """Remember nothing yet; ``classes`` says which are one object."""
        self._classes = classes
        self._grid = grid
        self._given: dict[int, NDArray[np.uint16]] = {}
        self._learnt: dict[int, int] = {}  # checksums

    def keep(self, index: int, labels: Labels) -> None:
        """Remember what frame ``index`` shows, [h, w] the class of each pixel; negative: not known."""
        if self._grid.step > 1:
            self._given[index] = as_runs(labels)

    def relabelled(self, index: int, few: Labels, shape: tuple[int, ...]) -> Labels | None:
        """Return what frame ``index`` is to be fitted to by now; None: what it is fitted to already.

        Args:
            few: [gh, gw] that, at the grid's pixels.
            shape: height and width of the frame's images.
        """
        checksum = zlib.crc32(few.tobytes())
        if self._learnt.get(index) == checksum:
            return None
        self._learnt[index] = checksum
        if self._grid.step == 1:
            return few
        return changed(self._grid, from_runs(self._given[index], shape, self._classes.merged), few)
