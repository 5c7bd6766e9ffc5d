# SPDX-License-Identifier: Apache-2.0
"""Two objects of the map that are one, and two that are two."""

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth
from ggwarp.objects.masks.merging import ObjectMerger


def stripes(*labels: int) -> np.ndarray:
    """Return [20, 10 n] labels, a stripe each."""
    return np.repeat(np.array([labels], np.int32), 10, axis=1).repeat(20, axis=0)


def shown_as_one(merger: ObjectMerger, known: np.ndarray, segments: np.ndarray, *, numbered: bool) -> list:
    """Let ``merger`` take in a frame; ``numbered``: segments bear the numbers of their objects."""
    height, width = known.shape
    depth = np.full(known.shape, 2.0, np.float32)
    surface = PosedDepth(depth, np.eye(4), Camera(width, height, 50.0, 50.0, 0.5 * width, 0.5 * height))
    mask = MaskView(surface, segments, MapKnowledge(known, known, known), None if numbered else segments)
    return merger.shown_as_one(mask)


def test_objects_under_one_segment_again_and_again_are_one() -> None:
    merger = ObjectMerger(ClassTable())
    known = stripes(1, 2, 3)
    assert shown_as_one(merger, known, stripes(0, 0, 1), numbered=False) == []
    assert shown_as_one(merger, known, stripes(5, 5, 4), numbered=False) == [(1, 2)]


def test_objects_seen_apart_stay_apart() -> None:
    merger = ObjectMerger(ClassTable())
    known = stripes(1, 2)
    shown_as_one(merger, known, stripes(0, 1), numbered=False)
    assert not any(shown_as_one(merger, known, stripes(0, 0), numbered=False) for _ in range(4))
    assert shown_as_one(merger, known, stripes(0, 0), numbered=False) == [(1, 2)], "five to one"


def test_a_revived_id_is_the_object_it_lies_on() -> None:
    merger = ObjectMerger(ClassTable())
    known, revived = stripes(1, 2), stripes(3, 2)
    assert shown_as_one(merger, known, revived, numbered=True) == []
    assert shown_as_one(merger, known, revived, numbered=True) == [(1, 3)]


def test_ids_that_masks_show_side_by_side_are_two() -> None:
    """A swapped frame gives object 1 the id 2, but others show both."""
    merger = ObjectMerger(ClassTable())
    known = stripes(1, 2)
    for _ in range(4):
        assert shown_as_one(merger, known, stripes(1, 2), numbered=True) == []
    assert not any(shown_as_one(merger, known, stripes(2, 2), numbered=True) for _ in range(5))


def test_what_was_seen_of_a_merged_object_counts_for_the_other() -> None:
    merger = ObjectMerger(ClassTable())
    shown_as_one(merger, stripes(2, 3), stripes(0, 0), numbered=False)
    merger.merge(1, 2)
    assert shown_as_one(merger, stripes(1, 3), stripes(0, 0), numbered=False) == [(1, 3)]


def test_nothing_is_merged_when_told_so_or_nothing_is_known() -> None:
    never = ObjectMerger(ClassTable(), together=0)
    assert not any(shown_as_one(never, stripes(1, 2), stripes(0, 0), numbered=False) for _ in range(5))
    assert shown_as_one(ObjectMerger(ClassTable()), stripes(-1, -1), stripes(-1, -1), numbered=True) == []


def test_objects_that_an_earlier_map_told_apart_stay_two() -> None:
    table = ClassTable()
    table.adopt([4, 6])
    merger = ObjectMerger(table)
    for _ in range(4):
        assert shown_as_one(merger, stripes(1, 2), stripes(0, 0), numbered=False) == []
    found = [shown_as_one(merger, stripes(2, 3), stripes(0, 0), numbered=False) for _ in range(2)]
    assert found == [[], [(2, 3)]], "a new one joins an old one"
