# SPDX-License-Identifier: Apache-2.0
"""Masks against the map: which object carries a wrong id in a frame.

A tracker that swaps two ids, loses an object or revives it under another id is wrong about a whole object at
once. The map remembers what the object was called before: one frame cannot rename it, more frames than
those that called it so can, unless these were several: a track that slips to another object for good takes
nothing with it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.objects.labels import Labels, contingency, thinned

_LEAST_PIXELS = 20
_MAJORITY = 0.5
_CLEAR = 0.8
_ESTABLISHED = 4
"""An object that came under its own name in so many views keeps it: the tracker's ids went astray."""


class LabelHistory:
    """How often each object of the map carried which label, in views.

    Attributes:
        counts: [classes, classes] views in which most of object i was labelled j.
    """

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((1, 1), np.int64)

    def overruled(
        self, known: Labels, given: Labels, classes: int, *, anew: bool = True
    ) -> list[tuple[int, int]]:
        """Take in a view; return (object, label) where its label is to be disbelieved.

        Args:
            known: [h, w] the map's class where it is sure, else negative.
            given: [h, w] the class that the mask gives.
            classes: classes so far.
            anew: count the view; False: it was taken in before.
        """
        grown = classes - len(self.counts)
        if grown > 0:
            self.counts = np.pad(self.counts, (0, grown))
        grid = thinned(*known.shape)
        table = contingency(known[grid], given[grid], classes)
        sizes = table.sum(axis=1)
        wrong: list[tuple[int, int]] = []
        for m in np.nonzero(sizes >= _LEAST_PIXELS)[0].tolist():
            label = int(table[m].argmax())
            if table[m, label] <= _MAJORITY * sizes[m]:
                continue
            self.counts[m, label] += anew
            # The object's own name came at least once: with the keyframe that made it.
            own = self.counts[m, m]
            if label != m and (own >= _ESTABLISHED or self.counts[m, label] <= max(own, 1)):
                wrong.append((m, label))
        return wrong

    def join(self, kept: int, gone: int) -> None:
        """Count what was seen of class ``gone`` for ``kept``."""
        size = max(kept, gone) + 1 - len(self.counts)
        if size > 0:
            self.counts = np.pad(self.counts, (0, size))
        for axis in (0, 1):
            counts = self.counts.swapaxes(0, axis)
            counts[kept] += counts[gone]
            counts[gone] = 0


def corrected(known: Labels, given: Labels, wrong: list[tuple[int, int]]) -> Labels:
    """Return ``given`` with the labels in ``wrong`` replaced by what the map knows.

    Where the map knows nothing, a part of the label follows what it hangs together with, when that is
    clearly one object; else it becomes unknown.
    """
    out = given.copy()
    for m, label in wrong:
        out[(known == m) & (given == label)] = m
    for label in sorted({label for _, label in wrong}):
        parts = cv2.connectedComponents((given == label).astype(np.uint8), connectivity=4)[1]
        owners = _owners(parts, known)
        free = (parts > 0) & (known < 0)
        out[free] = owners[parts[free]]
    return out


def _owners(parts: NDArray[np.int32], known: Labels) -> Labels:
    """Return the object to which each part clearly belongs; -1: none, or several."""
    count = int(parts.max()) + 1
    owners = np.full(count, -1, np.int32)
    inside = (parts > 0) & (known >= 0)
    part, objects = parts[inside], known[inside]
    if part.size == 0:
        return owners
    classes = int(objects.max()) + 1
    table = np.bincount(part.astype(np.int64) * classes + objects, minlength=count * classes)
    table = table.reshape(count, classes)
    best = table.argmax(axis=1).astype(np.int32)
    clear = table.max(axis=1) > _CLEAR * table.sum(axis=1)
    return np.where(clear, best, owners)
