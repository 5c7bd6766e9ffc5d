# SPDX-License-Identifier: Apache-2.0
"""The labels that keyframes came with, so that they can be labelled again."""

from __future__ import annotations

import zlib
from typing import Any

from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.labels import Labels
from ggwarp.objects.masks.label_grid import LabelPictures, MaskLabels, PackedLabels
from ggwarp.runtime.state import Stateful


class KeyframeLabels(Stateful):
    """Knows the class of every pixel as each keyframe came with it, and whether a new label is news."""

    STATE = ("_given", "_learnt")

    def __init__(self, classes: ClassTable, pictures: LabelPictures) -> None:
        """Remember nothing yet; ``classes`` says which are one object."""
        self._classes = classes
        self._pictures = pictures
        self._given: dict[int, PackedLabels] = {}
        self._learnt: dict[int, int] = {}  # checksums

    def keep(self, index: int, labels: MaskLabels) -> None:
        """Remember what frame ``index`` shows."""
        self._given[index] = PackedLabels.of(labels)

    def relabelled(self, index: int, few: Labels, shape: tuple[int, int]) -> Any:
        """Return what frame ``index`` is to be fitted to by now; None: what it is fitted to already.

        Args:
            few: [gh, gw] that, at the grid's pixels.
            shape: height and width of the frame's images.

        Returns:
            [h, w] int, on the device.
        """
        checksum = zlib.crc32(few.tobytes())
        if self._learnt.get(index) == checksum:
            return None
        self._learnt[index] = checksum
        given = self._given[index].unpacked(few.shape, self._classes)
        return self._pictures.changed(given, shape, few)[1]
