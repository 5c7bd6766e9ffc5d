# SPDX-License-Identifier: Apache-2.0
"""Mask association: which object of the map each of a frame's segments is.

Where the masks' ids mean the same object in every frame, they say it. Where they do not, segments are held
against what the map shows. Only pixels where the map shows the frame's own surface count. An object and a
segment are compared by their intersection over union there, so that what a segment adds to an object does not
speak against it, and paired one to one so that the sum is largest.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import ranked
from ggwarp.objects.class_table import IGNORED, NO_OBJECT, ClassTable
from ggwarp.objects.labels import Labels, contingency
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth
from ggwarp.objects.masks.tentative import Candidates
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64

_LEAST_IOU = 0.2  # a segment and an object that overlap less are not the same
_NEW_SHARE = 0.5  # a segment without an object is new where the map shows less than this share of it...
_LEAST_AREA = 2e-4  # ... and it covers at least this share of the image
_CONTAINED = 0.6  # a segment without an object of its own is a part of the one that has so much of it
_VIEWS = 2  # keyframes that must show an object before it counts as one
_SAME_IOU = 0.5  # a new id is an earlier map's object where the two overlap so much: for good


class Association(Protocol):
    """Says which object of the map each pixel of a mask is of."""

    def associate(self, mask: Labels, surface: PosedDepth, knowledge: MapKnowledge | None) -> MaskView:
        """Return what ``mask`` [h, w] says.

        Args:
            mask: an id for each pixel; 0 = no object, negative = not labelled.
            surface: where the pixels are.
            knowledge: what the map knows of them; None while the map is empty.
        """
        ...


class TrackedIds(Stateful):
    """Takes the masks' ids for the objects', which a tracker followed through the frames.

    Objects of an earlier map, which had other masks, are recognised by where they are.
    """

    def __init__(self, classes: ClassTable) -> None:
        """Prepare to encode; ``classes`` grows with every new id."""
        self._classes = classes

    def associate(self, mask: Labels, surface: PosedDepth, knowledge: MapKnowledge | None) -> MaskView:
        """See :meth:`Association.associate`."""
        ids, ranks = ranked(mask)
        if knowledge is not None and self._classes.earlier > 1:
            self._recognise(ids, ranks, surface, knowledge)
        return MaskView(surface, self._classes.encode_ids(ids)[ranks], knowledge)

    def _recognise(
        self, ids: Labels, ranks: NDArray[np.intp], surface: PosedDepth, knowledge: MapKnowledge
    ) -> None:
        """Give the ids that are new, and cover an earlier map's object, to that object."""
        new = [rank for rank, raw in enumerate(ids.tolist()) if raw > 0 and not self._classes.knows(raw)]
        if not new:
            return
        segments = ranks.astype(np.int32)
        areas = np.bincount(segments.ravel(), minlength=len(ids))
        ious = overlaps(segments, knowledge.seen, self._classes.count)[1][:, : self._classes.earlier]
        for rank in new:
            best = int(ious[rank].argmax())
            if ious[rank, best] >= _SAME_IOU and areas[rank] >= _LEAST_AREA * segments.size:
                self._classes.recognise(int(ids[rank]), best)


@dataclass(frozen=True)
class SegmentMatches:
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


def overlaps(
    segments: Labels, seen: Labels, classes: int
) -> tuple[NDArray[np.int64], Float64, NDArray[np.int64]]:
    """Compare a frame's S segments with the map's objects, where the map shows the frame's surface.

    Returns:
        [S, classes] pixels in common and their share of the union, with "no object" none; and [S] those of
        each segment where the map shows anything.
    """
    count = int(segments.max(initial=-1)) + 1
    table = contingency(segments, seen, max(count, classes))[:count, :classes]
    shown = table.sum(axis=1)
    table[:, 0] = 0
    areas = np.bincount(seen[seen >= 0], minlength=classes)
    unions = np.maximum(shown[:, None] + areas - table, 1)
    return table, table / unions, shown


def match_segments(segments: Labels, seen: Labels, classes: int) -> SegmentMatches:
    """Match a frame's segments with the map's objects.

    Args:
        segments: [h, w] segment 0..S-1 of each pixel; negative: none.
        seen: [h, w] class that the map shows there; negative: none.
        classes: classes so far; class 0, "no object", is matched with nothing.
    """
    from scipy.optimize import linear_sum_assignment

    count = int(segments.max(initial=-1)) + 1
    sizes = np.bincount(segments[segments >= 0], minlength=count)
    table, ious, shown = overlaps(segments, seen, classes)
    rows, columns = linear_sum_assignment(ious, maximize=True)
    good = ious[rows, columns] >= _LEAST_IOU

    out = np.full(count, -1, np.int32)
    out[rows[good]] = columns[good]
    paired = out >= 0
    large = sizes >= _LEAST_AREA * segments.size
    new = ~paired & large & (shown < _NEW_SHARE * sizes)
    best = table.argmax(axis=1).astype(np.int32)
    part = ~paired & ~new & (table.max(axis=1, initial=0) > _CONTAINED * np.maximum(shown, 1))
    rest = set(np.nonzero(large & ~paired & ~new)[0].tolist())
    return SegmentMatches(np.where(part, best, out), new, paired, rest)


class SegmentAssociation(Stateful):
    """Finds each frame's segments among the map's objects, and begins new ones."""

    STATE = ("_views", "_candidates")

    def __init__(self, classes: ClassTable) -> None:
        """Prepare to associate; ``classes`` grows with every object that begins."""
        self._classes = classes
        self._views: Counter[int] = Counter()
        self._candidates = Candidates(_VIEWS)

    def associate(self, mask: Labels, surface: PosedDepth, knowledge: MapKnowledge | None) -> MaskView:
        """See :meth:`Association.associate`; the ids of ``mask`` number the segments of this frame alone."""
        ids, ranks = ranked(mask)
        numbers = np.where(ids > 0, np.cumsum(ids > 0) - 1, IGNORED).astype(np.int32)
        segments = numbers[ranks]
        seen = np.full_like(mask, IGNORED) if knowledge is None else knowledge.seen
        matches = match_segments(segments, seen, self._classes.count)
        classes = matches.classes.copy()
        for segment in np.nonzero(matches.new)[0].tolist():
            if not self._classes.full:
                classes[segment] = self._classes.new_class()
        fresh = self._follow(segments, matches, classes, surface)
        for index in {*classes[matches.paired | matches.new].tolist(), *fresh} - {IGNORED}:
            self._views[index] += 1
            if self._views[index] >= _VIEWS:
                self._classes.assign_id(index)
        of_segment = np.append(classes, IGNORED)  # of no segment: the last
        labels = np.where(mask == NO_OBJECT, NO_OBJECT, of_segment[segments]).astype(np.int32)
        return MaskView(surface, labels, knowledge, segments, frozenset(fresh))

    def _follow(
        self, segments: Labels, matches: SegmentMatches, classes: Labels, surface: PosedDepth
    ) -> set[int]:
        """Write the class of segments that are objects inside others; return those classes."""
        fresh = set[int]()
        for segment, candidate in self._candidates.follow(segments, matches.open_segments, surface):
            if candidate.index is None:
                if self._classes.full:
                    continue
                candidate.index = self._classes.new_class()
            classes[segment] = candidate.index
            fresh.add(candidate.index)
        return fresh
