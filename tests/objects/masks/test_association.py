# SPDX-License-Identifier: Apache-2.0
"""Segments of unknown ids against the map's objects."""

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.objects import class_table
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.labels import Labels
from ggwarp.objects.masks.association import SegmentAssociation, TrackedIds, match_segments
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth


def stripes(*labels: int) -> Labels:
    """Return [20, 10 n] labels, a stripe each."""
    return np.repeat(np.array([labels], np.int32), 10, axis=1).repeat(20, axis=0)


def test_segments_find_their_objects_whatever_their_number() -> None:
    matches = match_segments(stripes(2, 0, 1), stripes(1, 2, 3), 4)
    assert matches.classes.tolist() == [2, 3, 1]
    assert matches.paired.all() and not matches.new.any() and not matches.open_segments


def test_what_the_map_does_not_show_is_new() -> None:
    matches = match_segments(stripes(0, 1), stripes(1, -1), 2)
    assert matches.classes.tolist() == [1, -1] and matches.new.tolist() == [False, True]


def test_new_surface_of_a_known_object_is_that_object() -> None:
    matches = match_segments(stripes(0, 0, 0, 0), stripes(1, -1, -1, -1), 2)
    assert matches.classes.tolist() == [1] and matches.paired.all()


def test_a_second_segment_on_an_object_is_a_part_of_it_and_open() -> None:
    matches = match_segments(stripes(0, 0, 1), stripes(1, 1, 1), 2)
    assert matches.classes.tolist() == [1, 1] and matches.paired.tolist() == [True, False]
    assert matches.open_segments == {1}


def test_no_object_is_no_match() -> None:
    matches = match_segments(stripes(0), stripes(0), 1)
    assert matches.classes.tolist() == [-1] and not matches.new.any()


def test_dots_are_not_objects() -> None:
    segments = np.zeros((100, 200), np.int32)
    segments[3, 4] = 1
    matches = match_segments(segments, np.full_like(segments, -1), 1)
    assert matches.new.tolist() == [True, False]


def test_nothing_segmented() -> None:
    matches = match_segments(stripes(-1, -1), stripes(1, 2), 3)
    assert len(matches.classes) == 0


class Wall:
    """A flat wall seen twice from the same place."""

    def __init__(self) -> None:
        depth = np.full((20, 40), 2.0, np.float32)
        self.surface = PosedDepth(depth, np.eye(4), Camera(40, 20, 30.0, 30.0, 19.5, 9.5))
        self.table = ClassTable()
        self.association = SegmentAssociation(self.table)

    def see(self, mask: Labels, known: Labels | None = None) -> list[int]:
        """Return the class of each stripe."""
        return self.associate(mask, known).labels[0, 5::10].tolist()

    def associate(self, mask: Labels, known: Labels | None) -> MaskView:
        knowledge = None if known is None else MapKnowledge(known, known, known)
        return self.association.associate(mask, self.surface, knowledge)


def test_objects_count_when_they_are_seen_again() -> None:
    wall = Wall()
    assert wall.see(stripes(9, 4, 0, 7)) == [3, 1, 0, 2]
    assert wall.table.ids.tolist() == [0, 0, 0, 0]
    assert wall.see(stripes(7, 8, 0, 2), stripes(3, 1, 0, -1)) == [3, 1, 0, 4]
    assert wall.table.ids.tolist() == [0, 1, 0, 2, 0]


def test_objects_that_one_mask_ran_together_are_told_apart_later() -> None:
    wall = Wall()
    assert wall.see(stripes(5, 5, 5, 6)) == [1, 1, 1, 2]
    known = stripes(1, 1, 1, 2)
    assert wall.see(stripes(3, 3, 8, 6), known) == [1, 1, 1, 2]
    assert wall.see(stripes(2, 2, 7, 1), known) == [1, 1, 3, 2], "seen by itself for the second time"
    mask = wall.associate(stripes(2, 2, 7, 1), known)
    assert mask.fresh == {3} and wall.table.ids[3] > 0


def test_one_frame_that_splits_an_object_does_not_divide_it() -> None:
    wall = Wall()
    wall.see(stripes(5, 5, 5, 6))
    known = stripes(1, 1, 1, 2)
    wall.see(stripes(3, 3, 8, 6), known)
    wall.see(stripes(5, 5, 5, 6), known)
    assert wall.see(stripes(3, 3, 8, 6), known) == [1, 1, 1, 2]


def test_there_is_a_bounded_number_of_objects(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(class_table, "MOST_CLASSES", 4)
    wall = Wall()
    assert wall.see(stripes(5, 5, 5, 6)) == [1, 1, 1, 2]
    known = stripes(1, 1, 1, 2)
    assert wall.see(stripes(3, 3, 8, 6), stripes(1, 1, -1, 2)) == [1, 1, 3, 2]
    assert wall.see(stripes(3, 8, 9, 6), stripes(1, -1, -1, 2)) == [1, -1, -1, 2], "what is new is left aside"
    for _ in range(3):
        mask = wall.associate(stripes(3, 3, 8, 6), known)
        assert mask.labels[0, 5::10].tolist() == [1, 1, 1, 2] and not mask.fresh, "nor is any divided"
    assert wall.table.count == 4 and len(caplog.records) == 1


def test_unlabelled_pixels_stay_so() -> None:
    assert Wall().see(stripes(-1, 0, 5, 5)) == [-1, 0, 1, 1]


def tracked(table: ClassTable, mask: Labels, seen: Labels | None) -> list[int]:
    """Return the class of each stripe of a mask whose ids a tracker followed."""
    wall = Wall()
    knowledge = None if seen is None else MapKnowledge(seen, seen, seen)
    view = TrackedIds(table).associate(mask, wall.surface, knowledge)
    return view.labels[0, 5::10].tolist()


def test_tracked_ids_are_recognised_as_an_earlier_map_s_objects() -> None:
    table = ClassTable()
    table.adopt([5, 6])
    seen = stripes(1, 1, 2, 0)
    assert tracked(table, stripes(6, 6, 9, 5), seen) == [1, 1, 2, 3], "by place, not by number"
    assert table.ids.tolist()[:3] == [0, 5, 6] and table.ids[3] not in (5, 6, 9)
    assert tracked(table, stripes(9, 9, 9, 5), seen) == [2, 2, 2, 3], "for good"


def test_a_small_part_of_an_earlier_object_is_not_it() -> None:
    table = ClassTable()
    table.adopt([5])
    assert tracked(table, stripes(8, 0, 0, 0), stripes(1, 1, 1, 0)) == [2, 0, 0, 0]
    assert tracked(ClassTable(), stripes(8, 0, 0, 0), None) == [1, 0, 0, 0]
