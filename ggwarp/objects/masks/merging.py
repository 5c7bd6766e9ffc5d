# SPDX-License-Identifier: Apache-2.0
"""Objects of the map that are one: revived under another id, or begun at two ends.

Two objects are one when keyframe after keyframe covers both with one segment, and (next to) none shows them
as two.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ggwarp.objects.class_table import NO_OBJECT, ClassTable
from ggwarp.objects.labels import contingency
from ggwarp.objects.masks.mask_view import MaskView
from ggwarp.runtime.state import Stateful

log = logging.getLogger(__name__)

_TOGETHER = 2  # keyframes that must cover both objects with one segment
_APART = 0.2  # ... for each of them, at most so many that show two
_COVERED = 0.6  # a segment covers an object when it has this share of what is seen of it...
_LEAST_AREA = 4e-4  # ... which is at least this share of the image


class ClassRecords(Protocol):
    """What is remembered of classes."""

    def merge(self, kept: int, gone: int) -> None:
        """Count what was seen of class ``gone`` for class ``kept``."""
        ...


class ObjectMerger(Stateful):
    """Counts how often two objects were shown as one, and as two; merges those that are one."""

    STATE = ("_together", "_apart")

    def __init__(self, classes: ClassTable, *others: ClassRecords, together: int = _TOGETHER) -> None:
        """Prepare to count.

        Args:
            classes: where objects are merged.
            others: what else remembers classes, and has to forget those that are gone.
            together: keyframes that must cover both with one segment; 0: objects are never merged.
        """
        self._classes = classes
        self._others = others
        self._least = together
        self._together: Counter[tuple[int, int]] = Counter()
        self._apart: Counter[tuple[int, int]] = Counter()

    def merge_shown_as_one(
        self, mask: MaskView, grown_together: Sequence[tuple[int, int]], *, frame_index: int
    ) -> None:
        """Take in a frame, and merge the objects that are one from now on.

        Args:
            mask: before the map's corrections.
            grown_together: pairs (kept, gone) of classes that are one, whatever masks show.
            frame_index: for the log.
        """
        pairs = [pair for pair in self.shown_as_one(mask) if not self._classes.same_mask_id(*pair)]
        for kept, gone in (*pairs, *grown_together):
            ids = self._classes.ids
            log.info("frame %d: objects %d and %d are one", frame_index, ids[kept], ids[gone])
            self._classes.merge(kept, gone)
            for records in (self, *self._others):
                records.merge(kept, gone)

    def shown_as_one(self, mask: MaskView) -> list[tuple[int, int]]:
        """Take in a frame; return the pairs (lower, higher class) that are one from now on."""
        if self._least == 0 or mask.knowledge is None:
            return []
        covers = _covering_segments(mask)
        found = []
        objects = sorted(covers)
        for i, one in enumerate(objects):
            for other in objects[i + 1 :]:
                pair = one, other
                if other < self._classes.earlier:  # an earlier map told them apart
                    continue
                if covers[one] != covers[other]:
                    self._apart[pair] += 1
                    continue
                self._together[pair] += 1
                together = self._together[pair]
                if together >= self._least and self._apart[pair] <= _APART * together:
                    found.append(pair)
        return found

    def merge(self, kept: int, gone: int) -> None:
        """Forget class ``gone``, which is ``kept`` from now on: what was seen of it goes there."""
        for counter in (self._together, self._apart):
            for pair in [p for p in counter if gone in p]:
                amount = counter.pop(pair)
                other = pair[0] if pair[1] == gone else pair[1]
                if other != kept:
                    counter[min(kept, other), max(kept, other)] += amount


def _covering_segments(mask: MaskView) -> dict[int, int]:
    """Return object -> the segment that covers it.

    Where segments bear objects' numbers, one shows the object of its own number even where the map does not.
    """
    least = _LEAST_AREA * mask.labels.size
    if mask.segments is not None:
        classes = int(max(mask.known.max(), mask.segments.max(), 0)) + 1
        return _covers(contingency(mask.known, mask.segments, classes), least)
    table = mask.overlaps[1:, 1:].copy()
    table[:, NO_OBJECT] = 0
    covers, areas = _covers(table, least), mask.overlaps[:, 1:].sum(axis=0)
    for m in np.flatnonzero(areas[1:] >= least).tolist():
        covers.setdefault(m + 1, m + 1)
    return covers


def _covers(table: NDArray[np.int64], least: float) -> dict[int, int]:
    """Return the same by [k, k] pixels of each object and segment; objects of fewer have none."""
    seen, best, most = table.sum(axis=1), table.argmax(axis=1), table.max(axis=1)
    covered = (seen >= least) & (most > _COVERED * seen)
    return {m: int(best[m]) for m in np.flatnonzero(covered).tolist() if m != NO_OBJECT}
