# SPDX-License-Identifier: Apache-2.0
"""A frame's segments against the map's objects: which is which, when the masks' ids do not say.

Only pixels where the map shows the frame's own surface count. An object and a segment are compared by their
intersection over union there, so that what a segment adds to an object does not speak against it, and paired
one to one so that the sum is largest.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ggwarp.objects.class_table import IGNORED, NO_OBJECT, ClassTable
from ggwarp.objects.labels import Labels, contingency, ranked, thinned
from ggwarp.objects.mask_view import PosedDepth
from ggwarp.objects.tentative import Candidates


@dataclass(frozen=True)
class AssociationConfig:
    """When a segment is an object of the map, and when it is a new one."""

    least_iou: float = 0.2
    """A segment and an object that overlap less are not the same."""
    new_share: float = 0.5
    """A segment without a match is new where the map shows less than this share of it..."""
    least_area: float = 2e-4
    """... and it covers at least this share of the image."""
    contained: float = 0.6
    """A segment without a match is a part of the object that has so much of it."""
    sightings: int = 2
    """Keyframes that must show an object before it counts as one."""


@dataclass(frozen=True)
class Matching:
    """What became of each of S segments.

    Attributes:
        classes: [S] the object's class; negative: none.
        new: [S] whether the segment begins an object.
        paired: [S] whether the object is its own in the one-to-one sense.
        open_segments: those that are neither, and large enough to be objects.
    """

    classes: Labels
    new: NDArray[np.bool_]
    paired: NDArray[np.bool_]
    open_segments: set[int]


@dataclass(frozen=True)
class AssociatedMask:
    """What a mask means.

    Attributes:
        labels: [h, w] class of each pixel; negative: not known.
        segments: [h, w] segment of each pixel; negative: none.
        fresh: classes that the map shows as others so far, and is to learn fast.
    """

    labels: Labels
    segments: Labels
    fresh: set[int] = field(default_factory=set)


def match_segments(segments: Labels, known: Labels, classes: int, config: AssociationConfig) -> Matching:
    """Match a frame's segments with the map's objects.

    Args:
        segments: [h, w] segment 0..S-1 of each pixel; negative: none.
        known: [h, w] class that the map shows there; negative: none.
        classes: classes so far; class 0, "no object", is matched with nothing.
    """
    from scipy.optimize import linear_sum_assignment

    grid = thinned(*segments.shape)
    segments, known = segments[grid], known[grid]
    count = int(segments.max(initial=-1)) + 1
    sizes = np.bincount(segments[segments >= 0], minlength=count)
    size = max(count, classes)
    table = contingency(segments, known, size)[:count, :classes]
    shown = table.sum(axis=1)
    table[:, 0] = 0
    areas = np.bincount(known[known >= 0], minlength=classes)
    unions = np.maximum(shown[:, None] + areas - table, 1)
    ious = table / unions
    rows, columns = linear_sum_assignment(ious, maximize=True)
    good = ious[rows, columns] >= config.least_iou

    out = np.full(count, -1, np.int32)
    out[rows[good]] = columns[good]
    paired = out >= 0
    least = config.least_area * segments.size
    large = sizes >= least
    new = ~paired & large & (shown < config.new_share * sizes)
    best = table.argmax(axis=1).astype(np.int32)
    part = ~paired & ~new & (table.max(axis=1, initial=0) > config.contained * np.maximum(shown, 1))
    rest = set(np.nonzero(large & ~paired & ~new)[0].tolist())
    return Matching(np.where(part, best, out), new, paired, rest)


class SegmentAssociation:
    """Finds each frame's segments among the map's objects, and begins new ones."""

    def __init__(self, config: AssociationConfig, classes: ClassTable) -> None:
        """Prepare to match; ``classes`` grows with every object that begins."""
        self._config = config
        self._classes = classes
        self._sightings: Counter[int] = Counter()
        self._candidates = Candidates(config.sightings)

    def match(self, mask: Labels, known: Labels | None, view: PosedDepth) -> AssociatedMask:
        """Return what ``mask`` [h, w] means.

        Args:
            mask: any id for each segment; 0 = no object, negative = not labelled.
            known: [h, w] class that the map shows there, negative: none; None while the map is empty.
            view: where the pixels are.
        """
        ids, ranks = ranked(mask)
        numbers = np.where(ids > 0, np.cumsum(ids > 0) - 1, IGNORED).astype(np.int32)
        segments = numbers[ranks]
        if known is None:
            known = np.full_like(mask, IGNORED)
        matching = match_segments(segments, known, self._classes.count, self._config)
        classes = matching.classes.copy()
        for segment in np.nonzero(matching.new)[0].tolist():
            classes[segment] = self._classes.begin()
        fresh = self._follow(segments, matching, classes, view)
        for index in {*classes[matching.paired | matching.new].tolist(), *fresh}:
            self._sightings[index] += 1
            if self._sightings[index] >= self._config.sightings:
                self._classes.name(index)
        of_segment = np.append(classes, IGNORED)  # of no segment: the last
        labels = np.where(mask == NO_OBJECT, NO_OBJECT, of_segment[segments])
        return AssociatedMask(labels.astype(np.int32), segments, fresh)

    def _follow(self, segments: Labels, matching: Matching, classes: Labels, view: PosedDepth) -> set[int]:
        """Write the class of segments that are objects inside others; return those classes."""
        fresh = set()
        for segment, candidate in self._candidates.follow(segments, matching.open_segments, view):
            if candidate.index is None:
                candidate.index = self._classes.begin()
            classes[segment] = candidate.index
            fresh.add(candidate.index)
        return fresh
