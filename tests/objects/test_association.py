# SPDX-License-Identifier: Apache-2.0
"""Segments of unknown ids against the map's objects."""

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.objects.association import AssociationConfig, SegmentAssociation, match_segments
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.labels import Labels
from ggwarp.objects.mask_view import PosedDepth

CONFIG = AssociationConfig()


def stripes(*labels: int) -> Labels:
    """Return [20, 10 n] labels, a stripe each."""
    return np.repeat(np.array([labels], np.int32), 10, axis=1).repeat(20, axis=0)


def test_segments_find_their_objects_whatever_their_number() -> None:
    matching = match_segments(stripes(2, 0, 1), stripes(1, 2, 3), 4, CONFIG)
    assert matching.classes.tolist() == [2, 3, 1]
    assert matching.paired.all() and not matching.new.any() and not matching.open_segments


def test_what_the_map_does_not_show_is_new() -> None:
    matching = match_segments(stripes(0, 1), stripes(1, -1), 2, CONFIG)
    assert matching.classes.tolist() == [1, -1] and matching.new.tolist() == [False, True]


def test_new_surface_of_a_known_object_is_that_object() -> None:
    matching = match_segments(stripes(0, 0, 0, 0), stripes(1, -1, -1, -1), 2, CONFIG)
    assert matching.classes.tolist() == [1] and matching.paired.all()


def test_a_second_segment_on_an_object_is_a_part_of_it_and_watched() -> None:
    matching = match_segments(stripes(0, 0, 1), stripes(1, 1, 1), 2, CONFIG)
    assert matching.classes.tolist() == [1, 1] and matching.paired.tolist() == [True, False]
    assert matching.open_segments == {1}


def test_no_object_is_no_match() -> None:
    matching = match_segments(stripes(0), stripes(0), 1, CONFIG)
    assert matching.classes.tolist() == [-1] and not matching.new.any()


def test_dots_are_not_objects() -> None:
    segments = np.zeros((100, 200), np.int32)
    segments[3, 4] = 1
    matching = match_segments(segments, np.full_like(segments, -1), 1, CONFIG)
    assert matching.new.tolist() == [True, False]


def test_nothing_segmented() -> None:
    matching = match_segments(stripes(-1, -1), stripes(1, 2), 3, CONFIG)
    assert len(matching.classes) == 0


class Wall:
    """A flat wall seen twice from the same place."""

    def __init__(self) -> None:
        depth = np.full((20, 40), 2.0, np.float32)
        self.view = PosedDepth(depth, np.eye(4), Camera(40, 20, 30.0, 30.0, 19.5, 9.5))
        self.table = ClassTable()
        self.matcher = SegmentAssociation(CONFIG, self.table)

    def see(self, mask: Labels, known: Labels | None = None) -> list[int]:
        """Return the class of each stripe."""
        understood = self.matcher.match(mask, known, self.view)
        return understood.labels[0, 5::10].tolist()


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
    understood = wall.matcher.match(stripes(2, 2, 7, 1), known, wall.view)
    assert understood.fresh == {3} and wall.table.ids[3] > 0


def test_one_frame_that_splits_an_object_does_not_divide_it() -> None:
    wall = Wall()
    wall.see(stripes(5, 5, 5, 6))
    known = stripes(1, 1, 1, 2)
    wall.see(stripes(3, 3, 8, 6), known)
    wall.see(stripes(5, 5, 5, 6), known)
    assert wall.see(stripes(3, 3, 8, 6), known) == [1, 1, 1, 2]


def test_unlabelled_pixels_stay_so() -> None:
    assert Wall().see(stripes(-1, 0, 5, 5)) == [-1, 0, 1, 1]
