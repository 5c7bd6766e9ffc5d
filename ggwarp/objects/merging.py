# SPDX-License-Identifier: Apache-2.0
"""Objects of the map that are one: revived under another id, or begun at two ends.

Two objects are one when keyframe after keyframe covers both with one segment, and (next to) none shows them
as two.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ggwarp.objects.labels import Labels, contingency, thinned


@dataclass(frozen=True)
class MergingConfig:
    """When two objects of the map become one."""

    together: int = 2
    """Keyframes that must cover both with one segment; 0: objects are never joined."""
    apart: float = 0.2
    """... for each of them, at most so many that show two."""
    covered: float = 0.6
    """A segment covers an object when it has this share of what is seen of it..."""
    least_area: float = 4e-4
    """... which is at least this share of the image."""


class ObjectMerger:
    """Counts how often two objects were shown as one, and as two."""

    def __init__(self, config: MergingConfig) -> None:
        self._config = config
        self._together: Counter[tuple[int, int]] = Counter()
        self._apart: Counter[tuple[int, int]] = Counter()

    def see(self, known: Labels, segments: Labels, *, own_names: bool) -> list[tuple[int, int]]:
        """Take in a keyframe; return the pairs (lower, higher class) that are one from now on.

        Args:
            known: [h, w] the map's class where it is sure, else negative.
            segments: [h, w] the segment of each pixel; negative: none.
            own_names: segments are numbered by the classes that the mask gives them: a segment shows the
                object of its own number even where the map does not.
        """
        c = self._config
        if c.together == 0:
            return []
        covers = self._covers(known, segments, own_names)
        found = []
        objects = sorted(covers)
        for i, one in enumerate(objects):
            for other in objects[i + 1 :]:
                pair = one, other
                if covers[one] != covers[other]:
                    self._apart[pair] += 1
                    continue
                self._together[pair] += 1
                together = self._together[pair]
                if together >= c.together and self._apart[pair] <= c.apart * together:
                    found.append(pair)
        return found

    def _covers(self, known: Labels, segments: Labels, own_names: bool) -> dict[int, int]:
        """Return object -> the segment that covers it."""
        c = self._config
        grid = thinned(*known.shape)
        known, segments = known[grid], segments[grid]
        size = int(max(known.max(), segments.max(), 0)) + 1
        table = contingency(known, segments, size)
        seen, best, least = table.sum(axis=1), table.argmax(axis=1), c.least_area * known.size
        covers = {
            m: int(best[m])
            for m in range(1, size)
            if seen[m] >= least and table[m, best[m]] > c.covered * seen[m]
        }
        if own_names:
            areas = np.bincount(segments[segments > 0], minlength=size)
            for m in np.nonzero(areas >= least)[0].tolist():
                covers.setdefault(m, m)
        return covers

    def join(self, kept: int, gone: int) -> None:
        """Forget class ``gone``, which is ``kept`` from now on: what was seen of it goes there."""
        for counter in (self._together, self._apart):
            for pair in [p for p in counter if gone in p]:
                amount = counter.pop(pair)
                other = pair[0] if pair[1] == gone else pair[1]
                if other != kept:
                    counter[min(kept, other), max(kept, other)] += amount
